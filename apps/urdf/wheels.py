"""The base that a URDF's wheels make: omni wheels whose axles meet, or two wheels on one axle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, cos, degrees, hypot, sin
from typing import Any

import msgspec
import numpy as np

from apps.urdf.model import Urdf
from apps.urdf.parts import half_m
from apps.urdf.rows import rounded
from cocoro.arrays import FloatArray
from cocoro.kinematics import Origin
from cocoro.omni import Omni, OmniWheel

RADIUS_M = 0.03
"""Of a wheel without a shape that could be read."""
MAX_SPEED_MPS = 0.3
"""Of the rims, where the URDF does not say less."""
_LEAST_SPEED_MPS = 0.01
_LEVEL = 0.1
"""Greatest z of a wheel's axis, a unit vector."""
_ALONG = 0.99
"""Least cosine between axes and the line through their wheels that count as one axle."""
_LEAST_M = 0.01
_MEETING = 0.2
"""Greatest distance of an axle from the point where they meet, as a share of the wheels' mean distance from it."""
_UNEVEN_M = 0.02
"""Greatest difference of the heights of the lowest points of wheels that stand on one floor."""
_LEAST_SPREAD = 0.05
"""Least determinant of the axles' normals, by the square of their number: parallel axles meet nowhere."""
_SAME_DEG = 0.01


@dataclass(frozen=True)
class Rolling:
    """A base of which kind, places and radii of the wheels are the URDF's."""

    table: dict[str, Any]
    """Kind, wheels and speed, as the fields of `[base]`."""
    joints: tuple[str, ...]
    root: Origin
    """The URDF's root in the body's frame, which is on the floor amid the wheels."""
    reach_m: float
    """From the middle to the farthest point of a wheel."""
    guessed: tuple[str, ...]
    """The wheels whose radius is not in the URDF."""


@dataclass(frozen=True)
class _Wheel:
    name: str
    centre_m: FloatArray
    """(3,), root's frame, as `axis`."""
    axis: FloatArray
    radius_m: float
    half_width_m: float
    known: bool

    @property
    def floor_m(self) -> float:
        return float(self.centre_m[2]) - self.radius_m


def rolling_of(urdf: Urdf, names: Sequence[str]) -> Rolling | None:
    """The base that these joints make; None when they make none that a description can have. Wheels are those whose
    axis is level."""
    poses = urdf.poses()
    wheels = [wheel for name in names if abs((wheel := _wheel(urdf, name, poses)).axis[2]) < _LEVEL]
    heights = [wheel.floor_m for wheel in wheels]
    if not wheels or max(heights) - min(heights) > _UNEVEN_M:
        return None
    found = _omni(wheels) if len(wheels) > 2 else _differential(wheels)
    if found is None:
        return None
    table, (x, y), yaw_rad = found
    c, s = cos(yaw_rad), sin(yaw_rad)
    place = rounded(-c * x - s * y), rounded(s * x - c * y), rounded(-float(np.mean(heights)))
    reach_m = max(hypot(*(wheel.centre_m[:2] - (x, y))) + max(wheel.radius_m, wheel.half_width_m) for wheel in wheels)
    speeds = [MAX_SPEED_MPS] + [(urdf.joints[w.name].velocity_radps or 1e3) * w.radius_m for w in wheels]
    table["max_wheel_speed_mps"] = rounded(max(min(speeds), _LEAST_SPEED_MPS), 4)
    guessed = tuple(wheel.name for wheel in wheels if not wheel.known)
    return Rolling(
        table, tuple(wheel.name for wheel in wheels), Origin(place, (0.0, 0.0, rounded(-yaw_rad))), reach_m, guessed
    )


def _wheel(urdf: Urdf, name: str, poses: dict[str, FloatArray]) -> _Wheel:
    """Its radius is that of a cylinder or ball about its axis, or half the greater side of a box across the axis."""
    joint = urdf.joints[name]
    pose = poses[joint.child]
    axis = pose[:3, :3] @ joint.axis
    best: tuple[float, float, FloatArray] | None = None
    for solid in urdf.links[joint.child].solids:
        half, place = half_m(solid), pose @ solid.place
        along = np.abs(place[:3, :3].T @ axis)
        thick = int(along.argmax())
        radius_m = float(max(half[side] for side in range(3) if side != thick))
        if radius_m > _LEAST_M and (best is None or radius_m > best[0]):
            best = radius_m, float(half[thick]), place[:3, 3]
    if best is None:
        return _Wheel(name, pose[:3, 3], axis, RADIUS_M, 0.0, False)
    return _Wheel(name, best[2], axis, best[0], best[1], True)


_Found = tuple[dict[str, Any], tuple[float, float], float]
"""The table, the body frame's origin x, y, m, and its x axis, rad, in the root's frame."""


def _omni(wheels: Sequence[_Wheel]) -> _Found | None:
    normals = np.array([(-wheel.axis[1], wheel.axis[0]) for wheel in wheels])
    centres = np.array([wheel.centre_m[:2] for wheel in wheels])
    square = normals.T @ normals
    if float(np.linalg.det(square)) < _LEAST_SPREAD * len(wheels) ** 2:
        return None
    offsets = (normals * centres).sum(axis=1)
    middle = np.linalg.solve(square, normals.T @ offsets)
    distances = np.linalg.norm(centres - middle, axis=1)
    if distances.min() < _LEAST_M or np.abs(normals @ middle - offsets).max() > _MEETING * distances.mean():
        return None
    rows = []
    for wheel, (x, y), distance_m in zip(wheels, (centres - middle).tolist(), distances.tolist(), strict=True):
        angle_deg = degrees(atan2(y, x))
        drive_deg = degrees(atan2(-wheel.axis[0], wheel.axis[1]))  # axis x up: turning about +y it drives along +x
        row = {
            "name": wheel.name,
            "distance_m": rounded(distance_m, 5),
            "angle_deg": rounded(angle_deg, 3),
            "radius_m": rounded(wheel.radius_m, 5),
        }
        if abs((drive_deg - angle_deg - 90.0 + 180.0) % 360.0 - 180.0) > _SAME_DEG:
            row["drive_deg"] = rounded(drive_deg, 3)
        rows.append(row)
    try:
        Omni([msgspec.convert(row, OmniWheel) for row in rows])
    except ValueError:
        return None
    return {"kind": "omni", "wheel": rows}, (float(middle[0]), float(middle[1])), 0.0


def _differential(wheels: Sequence[_Wheel]) -> _Found | None:
    if len(wheels) != 2:
        return None
    apart = wheels[1].centre_m[:2] - wheels[0].centre_m[:2]
    separation_m = float(np.linalg.norm(apart))
    if separation_m < 2 * _LEAST_M or any(
        abs(float(wheel.axis[:2] @ apart)) < _ALONG * separation_m for wheel in wheels
    ):
        return None
    left = apart / separation_m
    if left[1] < 0.0:  # the body's x axis is near the root's
        left = -left
    middle = (wheels[0].centre_m[:2] + wheels[1].centre_m[:2]) / 2
    table = {
        "kind": "differential",
        "wheel_separation_m": rounded(separation_m, 5),
        "wheel_radius_m": rounded((wheels[0].radius_m + wheels[1].radius_m) / 2, 5),
    }
    return table, (float(middle[0]), float(middle[1])), atan2(-left[0], left[1])
