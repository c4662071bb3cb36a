"""A Calliope whose joints and links have other names, and whose servos are all on one line together with those of three
wheels, as on a LeKiwi."""

from __future__ import annotations

from typing import Any

from cocoro.robot import Robot
from cocoro.servo_units import Protocol

CALLIOPE = Robot.load()
NAMES = {*CALLIOPE.links, *CALLIOPE.joints} - {"camera"}
LINE = "bus"
WHEELS = ("wheel_left", "wheel_back", "wheel_right")


def its(name: str) -> str:
    """What the joint or link of a Calliope is called here."""
    return f"its_{name}" if name in NAMES else name


def one_line(protocol: Protocol = "feetech") -> Robot:
    return Robot.from_data(one_line_data(protocol))


def one_line_data(protocol: Protocol = "feetech") -> dict[str, Any]:
    data: dict[str, Any] = _renamed(CALLIOPE.to_data())
    data["network"] = {LINE: {**data["network"]["arm"], "protocol": protocol}}
    for row in data["joint"]:
        row["network"] = LINE
    for number, name in enumerate(WHEELS):
        wheel = {"name": name, "network": LINE, "id": 10 + number, "limits_deg": [-180.0, 180.0]}
        data["joint"].append({**wheel, "torque_nm": 1.0, "max_speed_radps": 3.0})
    return data


def _renamed(data: Any) -> Any:
    if isinstance(data, dict):
        return {_renamed(key): _renamed(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_renamed(one) for one in data]
    return its(data) if isinstance(data, str) else data
