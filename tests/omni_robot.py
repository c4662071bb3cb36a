"""A Calliope on three omni wheels instead of its two: wheels as LeKiwi's (huggingface/lerobot,
`src/lerobot/robots/lekiwi/lekiwi.py`: radius 0.05 m, 0.125 m from the middle, their driving directions 150, -90 and 30
degrees), under a body that is heavier and slower."""

from __future__ import annotations

from typing import Any

from cocoro.robot import Robot

WHEELS = [
    {"name": name, "distance_m": 0.125, "angle_deg": angle_deg, "radius_m": 0.05}
    for name, angle_deg in (("left", 60.0), ("back", 180.0), ("right", 300.0))
]
OMNI = {
    "kind": "omni",
    "wheel_separation_m": None,
    "wheel_radius_m": None,
    "wheel": WHEELS,
    "max_wheel_speed_mps": 0.3,
    "wheel_acceleration_mps2": 1.5,
}


def omni_data(**base: Any) -> dict[str, Any]:
    """The description as data, with other values in `[base]`."""
    data = Robot.load().to_data()
    data["base"] |= OMNI | base
    return data


def omni_robot(**base: Any) -> Robot:
    return Robot.from_data(omni_data(**base))
