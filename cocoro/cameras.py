"""The table `[[camera]]` of a robot description, and the forms that it had before."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from cocoro.units import Positive, Vec3

LensValues = tuple[float, float, float, float, float, float, float, float, float]
"""fx, fy, cx, cy in pixels, then OpenCV's distortion coefficients k1, k2, p1, p2, k3."""
DepthUnit = Literal["none", "kinect", "mm"]
_FORMER = "kinect"
"""Name of the table of the only camera, before there could be several; and the camera's own name since."""


class CameraRow(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One camera. Its link's frame is that of its colour: x right, y down, z forward."""

    name: str
    link: str
    """The link that carries it."""
    width: Annotated[int, Meta(ge=1, le=4096)]
    height: Annotated[int, Meta(ge=1, le=4096)]
    rate_hz: Positive
    horizontal_fov_rad: Positive
    vertical_fov_rad: Positive
    depth: DepthUnit = "none"
    """What a code of its depth image is. kinect: 11 bits, z = a tan(code / b + c) with `depth_curve`, 2047 is no data;
    mm: millimetres along the optical axis, 65535 is no data. A camera without depth sees colour alone."""
    min_range_m: Annotated[float, Meta(ge=0)] = 0.0
    max_range_m: Positive = 3.0
    """Range in which it measures depth; without depth, that in which its colour finds things."""
    depth_offset_m: Vec3 = (0.0, 0.0, 0.0)
    """Place of the depth camera in the colour camera's frame."""
    projector_offset_m: Vec3 = (0.0, 0.0, 0.0)
    """Place of what lights the scene for the depth camera, in the colour camera's frame."""
    depth_curve: Vec3 | None = None
    mount_min_m: Vec3 | None = None
    mount_max_m: Vec3 | None = None
    """The box that holds the camera up, body frame, which arm and hand must not enter; both corners or none."""
    colour_lens: LensValues | None = None
    depth_lens: LensValues | None = None
    """Calibration of both lenses. The driver rectifies its images; readers of frames use the fields of view above."""
    depth_rotation_rad: Vec3 = (0.0, 0.0, 0.0)
    """Rotation vector from the depth camera's frame to the colour camera's."""

    def __post_init__(self) -> None:
        if (self.depth == "kinect") != (self.depth_curve is not None):
            raise ValueError(f"camera {self.name}: depth_curve belongs to depth = 'kinect', here it is {self.depth!r}")
        if not self.min_range_m < self.max_range_m:
            raise ValueError(f"camera {self.name}: min_range_m must be below max_range_m")

    @property
    def mount(self) -> tuple[Vec3, Vec3] | None:
        """The corners of the mount's box; None where nothing is to be kept clear of."""
        low_m, high_m = self.mount_min_m, self.mount_max_m
        return None if low_m is None or high_m is None else (low_m, high_m)

    @property
    def curve(self) -> Vec3:
        """`depth_curve` of a camera with a Kinect's codes. Raises ValueError for another."""
        if self.depth_curve is None:
            raise ValueError(f"the depth of the camera {self.name} has no curve: it is {self.depth!r}")
        return self.depth_curve

    @property
    def no_depth_code(self) -> int:
        """The least code that stands for no data."""
        return 65535 if self.depth == "mm" else 2047


def eye_of(cameras: Iterable[CameraRow], eye: str) -> CameraRow:
    """The camera with a name, '' for the first. Raises ValueError where there is none."""
    rows = list(cameras)
    for row in rows:
        if eye in (row.name, ""):
            return row
    raise ValueError(f"eye: there is no camera {eye!r}; there are {', '.join(row.name for row in rows)}")


def with_rows(data: dict[str, Any], base: dict[str, Any] | None = None) -> dict[str, Any]:
    """A description's data, or data that is to be merged into `base`, with its cameras as a list of rows.

    A table `[camera]` is the only camera; in data for `base` it changes the one by which that robot finds things. So
    does a table `[kinect]`, the former name of a camera with a Kinect's depth.
    """
    if not isinstance(data.get("camera"), dict) and _FORMER not in data:
        return data
    data = dict(data)
    former, now = data.pop(_FORMER, None), data.pop("camera", [])
    own = {} if base is None else _eye(base, data.get("eye"))
    rows: list[Any] = []
    if former is not None:
        if not isinstance(former, dict):
            raise ValueError(f"{_FORMER}: it must be a table")
        as_it_was = {"name": _FORMER, "link": "camera", "depth": "kinect"}  # what needed no saying
        rows.append({**(as_it_was if base is None else own), **former})
    if isinstance(now, dict):
        rows.append({**({"name": "camera"} if base is None else own), **now})
    else:
        rows += now
    return {**data, "camera": rows}


def _eye(base: dict[str, Any], eye: Any) -> dict[str, Any]:
    """The name of the camera by which the robot finds things, as the beginning of a row."""
    rows = [row for row in base.get("camera", []) if isinstance(row, dict)]
    return {"name": eye or base.get("eye") or (rows[0].get("name") if rows else "")}
