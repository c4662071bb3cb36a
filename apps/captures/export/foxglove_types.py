"""Foxglove's well-known schemas (https://docs.foxglove.dev/docs/visualization/message-schemas), as far as they are
used here, in their JSON form: bytes travel in base 64, as msgspec writes them."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import msgspec

from cocoro.capture.types import ENCODING, TypeSchema
from cocoro.clock import NS
from cocoro.units import Quaternion as Turn
from cocoro.units import Vec3

INFO, ERROR = 2, 4
"""Of `Log.level`."""
LINE_LOOP = 2
"""Of `PointsAnnotation.type`."""
LINE_LIST = 2
"""Of `LinePrimitive.type`."""
UINT8, FLOAT32 = 1, 7
"""Of `PackedElementField.type`."""


class Time(msgspec.Struct):
    sec: int
    nsec: int


def time_of(stamp_ns: int) -> Time:
    return Time(*divmod(max(stamp_ns, 0), NS))


class Duration(msgspec.Struct):
    sec: int = 0
    nsec: int = 0


class Vector3(msgspec.Struct):
    x: float
    y: float
    z: float


class Quaternion(msgspec.Struct):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


class Pose(msgspec.Struct):
    position: Vector3
    orientation: Quaternion


def pose_of(place: Vec3, turn: Turn = (0.0, 0.0, 0.0, 1.0)) -> Pose:
    return Pose(Vector3(*place), Quaternion(*turn))


class Color(msgspec.Struct):
    r: float
    g: float
    b: float
    a: float = 1.0


class Point2(msgspec.Struct):
    x: float
    y: float


class CompressedImage(msgspec.Struct):
    timestamp: Time
    frame_id: str
    data: bytes
    format: str


class CameraCalibration(msgspec.Struct):
    timestamp: Time
    frame_id: str
    width: int
    height: int
    distortion_model: str
    D: tuple[float, ...]
    K: tuple[float, ...]
    R: tuple[float, ...]
    P: tuple[float, ...]


class FrameTransform(msgspec.Struct):
    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class FrameTransforms(msgspec.Struct):
    transforms: list[FrameTransform]


class PackedElementField(msgspec.Struct):
    name: str
    offset: int
    type: int


class PointCloud(msgspec.Struct):
    timestamp: Time
    frame_id: str
    pose: Pose
    point_stride: int
    fields: tuple[PackedElementField, ...]
    data: bytes


class KeyValuePair(msgspec.Struct):
    key: str
    value: str


class CubePrimitive(msgspec.Struct):
    pose: Pose
    size: Vector3
    color: Color


class SpherePrimitive(msgspec.Struct):
    pose: Pose
    size: Vector3
    color: Color


class CylinderPrimitive(msgspec.Struct):
    pose: Pose
    size: Vector3
    bottom_scale: float
    top_scale: float
    color: Color


class LinePrimitive(msgspec.Struct):
    type: int
    pose: Pose
    thickness: float
    scale_invariant: bool
    points: list[Vector3]
    color: Color
    colors: list[Color]
    indices: list[int]


class TextPrimitive(msgspec.Struct):
    pose: Pose
    billboard: bool
    font_size: float
    scale_invariant: bool
    color: Color
    text: str


class SceneEntity(msgspec.Struct, kw_only=True):
    timestamp: Time
    frame_id: str
    id: str
    lifetime: Duration = msgspec.field(default_factory=Duration)
    frame_locked: bool = True
    metadata: list[KeyValuePair] = []
    arrows: list[Any] = []
    cubes: list[CubePrimitive] = []
    spheres: list[SpherePrimitive] = []
    cylinders: list[CylinderPrimitive] = []
    lines: list[LinePrimitive] = []
    triangles: list[Any] = []
    texts: list[TextPrimitive] = []
    models: list[Any] = []


class SceneUpdate(msgspec.Struct):
    entities: list[SceneEntity]
    deletions: list[Any] = []


class Log(msgspec.Struct):
    timestamp: Time
    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


class PointsAnnotation(msgspec.Struct, kw_only=True):
    timestamp: Time
    type: int
    points: list[Point2]
    outline_color: Color
    outline_colors: list[Color] = []
    fill_color: Color
    thickness: float
    metadata: list[KeyValuePair] = []


class TextAnnotation(msgspec.Struct, kw_only=True):
    timestamp: Time
    position: Point2
    text: str
    font_size: float
    text_color: Color
    background_color: Color
    metadata: list[KeyValuePair] = []


class ImageAnnotations(msgspec.Struct):
    points: list[PointsAnnotation]
    texts: list[TextAnnotation]
    circles: list[Any] = []


_TITLES = {"Time": "time", "Duration": "duration"}


@cache
def schema_of(kind: type[msgspec.Struct]) -> TypeSchema:
    """By Foxglove's name; every part written out, since its readers follow no references."""
    whole = msgspec.json.schema(kind)
    parts = whole["$defs"]

    def written_out(node: Any) -> Any:
        if isinstance(node, dict):
            if "$ref" in node:
                return written_out(parts[node["$ref"].rpartition("/")[2]])
            found = {name: written_out(value) for name, value in node.items() if name not in ("$defs", "default")}
            if found.get("type") == "object" and isinstance(found.get("title"), str):
                found["title"] = _TITLES.get(found["title"], f"foxglove.{found['title']}")
            return found
        return [written_out(item) for item in node] if isinstance(node, list) else node

    name = f"foxglove.{kind.__name__}"
    return TypeSchema(name, ENCODING, json.dumps(written_out(whole), separators=(",", ":")).encode())
