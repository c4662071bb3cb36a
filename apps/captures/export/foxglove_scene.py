"""What Foxglove shows of a robot: Foxglove's own messages (foxglove-sdk, an extra), in a capture's export and live.

Coordinate frames: `map`, in which the planner's floor map is; `odometry` in it, for a search corrects the odometry;
`body`; and each link's, by its name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from math import hypot
from typing import Any, NamedTuple

import cv2
import numpy as np

from apps.captures.export import geometry
from apps.captures.export.story import PhaseNews
from apps.pictures import describe
from cocoro.capture.conventions import CaptureError
from cocoro.clock import NS
from cocoro.frames import Pose2, wrap_rad
from cocoro.messages import (
    BaseState,
    Detections,
    FloorPlan,
    Frame,
    Message,
    PlannerStatus,
    ServoState,
    TargetEstimate,
    TaskState,
    Truth,
)
from cocoro.objects import Catalogue, ObjectSpec
from cocoro.robot import Robot
from cocoro.units import Vec3

try:
    from foxglove import messages as fg
except ModuleNotFoundError as error:
    raise CaptureError("--foxglove needs foxglove-sdk: pip install 'cocoro-mesh[foxglove]'") from error

MAP, ODOMETRY, BODY = "map", "odometry", "body"
"""Names of coordinate frames."""
DEPTH_STEP = 4
"""Every so many rows and columns of the depth image become points."""
POINT_STEP_M = 2.0**-10
"""Points are rounded to this, a fifth of the sensor's step at 1.5 m: then the compression finds what is equal."""
JPEG_QUALITY = 90
MOVED_M, TURNED_RAD = 0.002, 0.002
"""Smaller corrections of the odometry are not shown."""


def _colour(red: float, green: float, blue: float, alpha: float = 1.0) -> fg.Color:
    return fg.Color(r=red, g=green, b=blue, a=alpha)


WHITE, BLACK, BONE = _colour(1, 1, 1), _colour(0, 0, 0, 0.6), _colour(0.85, 0.85, 0.9)
TRUE, NOTHING, PLANNED = _colour(0.2, 0.9, 0.3, 0.45), _colour(0, 0, 0, 0), _colour(0.2, 0.6, 1.0)
CELLS = np.array([(0, 0, 0, 0), (90, 120, 95, 130), (220, 90, 60, 230)], dtype=np.uint8)
"""Red, green, blue and alpha of a cell that was not seen, is free, is occupied."""

TOPICS: Mapping[str, Any] = {
    "/tf": fg.FrameTransforms,
    "/robot/chassis": fg.SceneUpdate,
    "/robot/links": fg.SceneUpdate,
    "/camera/colour": fg.CompressedImage,
    "/camera/calibration": fg.CameraCalibration,
    "/camera/depth": fg.RawImage,
    "/camera/points": fg.PointCloud,
    "/camera/annotations": fg.ImageAnnotations,
    "/map": fg.Grid,
    "/planned": fg.SceneUpdate,
    "/believed": fg.SceneUpdate,
    "/truth": fg.SceneUpdate,
    "/log": fg.Log,
}
"""Foxglove's type of each topic that is shown."""


class Shown(NamedTuple):
    """One message for Foxglove."""

    topic: str
    message: Any
    """One of Foxglove's types."""


class FoxgloveScene:
    """Makes Foxglove's messages of the robot's."""

    def __init__(
        self,
        robot: Robot,
        catalogue: Catalogue,
        *,
        wanted: Callable[[str], bool] = lambda _: True,
        depth: bool = False,
        again_ns: int | None = None,
    ) -> None:
        """`wanted`: whether anybody wants a topic; little of what nobody wants is made, and no picture. `depth`: show
        the depth image, too. `again_ns`: show what does not change again after so long, for viewers that come later.
        """
        self._robot = robot
        self._catalogue = catalogue
        self._wanted = wanted
        self._depth = depth
        self._again_ns = again_ns
        self._posture = geometry.Posture(robot)
        self._phases = PhaseNews()
        self._stands = False
        self._map_from_odometry = Pose2()
        self._last_ns: dict[str, int] = {}
        """When something that seldom changes was shown."""
        self._cloud_ns = -geometry.POINTS_PERIOD_NS
        """Stamp of the newest cloud of points."""

    def of(self, message: Message) -> Iterator[Shown]:
        """Foxglove's messages for one of the robot's, in the order of their stamps."""
        at = _time(message.stamp_ns)
        if isinstance(message, Frame):
            yield from self._frame(message)
        elif isinstance(message, BaseState):
            self._posture.move(message)
            self._stands = message.speed_mps == 0.0 and message.turn_rate_radps == 0.0
            if self._wanted("/tf"):
                yield Shown("/tf", fg.FrameTransforms(transforms=[self._body(at)]))
            if self._due("chassis", message.stamp_ns):
                yield Shown("/robot/chassis", fg.SceneUpdate(entities=[self._chassis(at)]))
        elif isinstance(message, ServoState):
            self._posture.bend(message)
            if self._wanted("/tf") or self._wanted("/robot/links"):
                yield from self._links(at)
        elif isinstance(message, Detections):
            if self._wanted("/camera/annotations"):
                yield Shown("/camera/annotations", self._annotations(at, message))
        elif isinstance(message, PlannerStatus):
            yield from self._plan(at, message)
        elif isinstance(message, FloorPlan):
            yield Shown("/map", _grid(at, message))
            yield Shown("/planned", fg.SceneUpdate(entities=[_way(at, message)]))
        elif isinstance(message, TaskState):
            yield from self._log(at, message)
        elif isinstance(message, Truth) and self._wanted("/truth"):
            yield Shown("/truth", fg.SceneUpdate(entities=[self._true(at, message)]))

    def _due(self, what: str, stamp_ns: int) -> bool:
        """Whether something that seldom changes is to be shown: once, or again for who has come since."""
        last_ns = self._last_ns.get(what)
        if last_ns is not None and (self._again_ns is None or 0 <= stamp_ns - last_ns < self._again_ns):
            return False
        self._last_ns[what] = stamp_ns
        return True

    def _plan(self, at: fg.Timestamp, plan: PlannerStatus) -> Iterator[Shown]:
        if plan.body_m is not None and (self._stands or not self._last_ns.get("map")):
            # While it drives, the newest odometry may not be the one that the planner had.
            map_from_odometry = Pose2(*plan.body_m, plan.body_yaw_rad).compose(self._posture.body.inverse())
            off = map_from_odometry.inverse().compose(self._map_from_odometry)
            if hypot(off.x_m, off.y_m) > MOVED_M or abs(wrap_rad(off.yaw_rad)) > TURNED_RAD:
                self._map_from_odometry = map_from_odometry
                self._last_ns.pop("map", None)
        if self._due("map", plan.stamp_ns):
            x, y, yaw_rad = self._map_from_odometry
            turn = geometry.about_z(yaw_rad)
            yield Shown("/tf", fg.FrameTransforms(transforms=[_transform(at, MAP, ODOMETRY, (x, y, 0.0), turn)]))
        if self._wanted("/believed"):
            believed = [self._believed(at, known) for known in plan.known]
            yield Shown("/believed", fg.SceneUpdate(entities=believed))

    def _frame(self, frame: Frame) -> Iterator[Shown]:
        at = _time(frame.stamp_ns)
        if self._wanted("/camera/colour"):
            pixels = np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)
            _, jpeg = cv2.imencode(
                ".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
            )
            picture = fg.CompressedImage(
                timestamp=at, frame_id=self._robot.eye.link, data=jpeg.tobytes(), format="jpeg"
            )
            yield Shown("/camera/colour", picture)
        camera = self._robot.camera.scaled(frame.width, frame.height)
        k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
        calibration = fg.CameraCalibration(
            timestamp=at, frame_id=self._robot.eye.link, width=frame.width, height=frame.height, K=k,
            R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], P=[*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0],
        )  # fmt: skip
        yield Shown("/camera/calibration", calibration)
        if self._depth and frame.has_depth and self._wanted("/camera/depth"):
            yield Shown("/camera/depth", self._depth_image(at, frame))
        if 0 <= frame.stamp_ns - self._cloud_ns < geometry.POINTS_PERIOD_NS or not self._wanted("/camera/points"):
            return
        self._cloud_ns = frame.stamp_ns
        places, colours = geometry.points(frame, self._robot, DEPTH_STEP)
        packed = np.zeros(len(places), dtype=[("place", "<f4", 3), ("colour", "u1", 3), ("alpha", "u1")])
        packed["place"] = np.rint(places / POINT_STEP_M) * POINT_STEP_M
        packed["colour"], packed["alpha"] = colours, 255
        number, byte = fg.PackedElementFieldNumericType.Float32, fg.PackedElementFieldNumericType.Uint8
        fields = [fg.PackedElementField(name=name, offset=4 * n, type=number) for n, name in enumerate("xyz")]
        fields += [
            fg.PackedElementField(name=name, offset=12 + n, type=byte)
            for n, name in enumerate(("red", "green", "blue", "alpha"))
        ]
        cloud = fg.PointCloud(
            timestamp=at, frame_id=self._robot.eye.link, pose=_pose((0.0, 0.0, 0.0)), point_stride=16, fields=fields,
            data=packed.tobytes(),
        )  # fmt: skip
        yield Shown("/camera/points", cloud)

    def _depth_image(self, at: fg.Timestamp, frame: Frame) -> fg.RawImage:
        raw = np.frombuffer(frame.depth, dtype="<u2").reshape(frame.height, frame.width)
        depth_mm = np.nan_to_num(1e3 * self._robot.depth_m(raw), nan=0.0).astype("<u2")
        return fg.RawImage(
            timestamp=at, frame_id=self._robot.eye.link, width=frame.width, height=frame.height, encoding="16UC1",
            step=2 * frame.width, data=depth_mm.tobytes(),
        )  # fmt: skip

    def _body(self, at: fg.Timestamp) -> fg.FrameTransform:
        body = self._posture.body
        return _transform(at, ODOMETRY, BODY, (body.x_m, body.y_m, 0.0), geometry.about_z(body.yaw_rad))

    def _chassis(self, at: fg.Timestamp) -> fg.SceneEntity:
        base = self._robot.base
        size = fg.Vector3(x=base.chassis_diameter_m, y=base.chassis_diameter_m, z=base.chassis_height_m)
        chassis = _cylinder(_pose((0.0, 0.0, base.chassis_height_m / 2)), size, BONE)
        return _entity(at, "chassis", cylinders=[chassis])

    def _links(self, at: fg.Timestamp) -> Iterator[Shown]:
        links = self._posture.links()
        if not links:
            return
        transforms = [
            _transform(at, BODY, name, tuple(map(float, pose[:3, 3])), geometry.quaternion(pose[:3, :3]))
            for name, pose in links.items()
        ]
        yield Shown("/tf", fg.FrameTransforms(transforms=transforms))
        ends = [fg.Point3(x=x, y=y, z=z) for bone in self._posture.bones(links) for x, y, z in bone]
        line = fg.LinePrimitive(
            type=fg.LinePrimitiveLineType.LineList, pose=_pose((0.0, 0.0, 0.0)), thickness=0.02, points=ends, color=BONE
        )
        yield Shown("/robot/links", fg.SceneUpdate(entities=[_entity(at, "links", lines=[line])]))

    def _annotations(self, at: fg.Timestamp, seen: Detections) -> fg.ImageAnnotations:
        boxes, texts = [], []
        for detection in seen.detections:
            left, top, right, bottom = map(float, detection.box_px)
            corners = [fg.Point2(x=x, y=y) for x, y in ((left, top), (right, top), (right, bottom), (left, bottom))]
            boxes.append(
                fg.PointsAnnotation(
                    timestamp=at, type=fg.PointsAnnotationType.LineLoop, points=corners,
                    outline_color=self._colour_of(detection.label), fill_color=NOTHING, thickness=2,
                )
            )  # fmt: skip
            texts.append(
                fg.TextAnnotation(
                    timestamp=at, position=fg.Point2(x=left, y=top), text=describe(detection), font_size=14,
                    text_color=WHITE, background_color=BLACK,
                )
            )  # fmt: skip
        return fg.ImageAnnotations(points=boxes, texts=texts)

    def _believed(self, at: fg.Timestamp, known: TargetEstimate) -> fg.SceneEntity:
        x, y, z = known.position_m
        words = f"{known.label}, {known.age_s:.1f} s ago" if known.age_s > 0.5 else known.label
        text = fg.TextPrimitive(pose=_pose((x, y, z + 0.1)), billboard=True, font_size=0.04, color=WHITE, text=words)
        shape = _shape(self._catalogue.get(known.label), known.position_m, self._colour_of(known.label))
        return _entity(at, f"believed {known.label}", lifetime_s=1, texts=[text], **_by_kind([shape]))

    def _true(self, at: fg.Timestamp, truth: Truth) -> fg.SceneEntity:
        """The true objects in the body frame, which is the frame of the believed ones."""
        shapes = []
        for item in truth.objects:
            if item.kind == "object":
                place = geometry.in_body(truth, item.position_m)
                shapes.append(_shape(self._catalogue.get(item.label), place, TRUE))
        return _entity(at, "true", **_by_kind(shapes))

    def _log(self, at: fg.Timestamp, task: TaskState) -> Iterator[Shown]:
        if words := self._phases.told_by(task):
            level = fg.LogLevel.Error if task.outcome == "failed" else fg.LogLevel.Info
            yield Shown("/log", fg.Log(timestamp=at, level=level, message=words, name="executive"))

    def _colour_of(self, label: str) -> fg.Color:
        known = self._catalogue.get(label)
        return _colour(*known.rgb) if known is not None else WHITE


def _time(stamp_ns: int) -> fg.Timestamp:
    return fg.Timestamp(*divmod(max(stamp_ns, 0), NS))


def _pose(place: Vec3) -> fg.Pose:
    x, y, z = place
    return fg.Pose(position=fg.Vector3(x=x, y=y, z=z), orientation=fg.Quaternion(x=0, y=0, z=0, w=1))


def _transform(at: fg.Timestamp, parent: str, child: str, place: Any, turn: Any) -> fg.FrameTransform:
    """`place` is x, y, z in metres, `turn` a quaternion x, y, z, w: the child's frame in the parent's."""
    translation = fg.Vector3(**dict(zip("xyz", place, strict=True)))
    rotation = fg.Quaternion(**dict(zip("xyzw", turn, strict=True)))
    return fg.FrameTransform(
        timestamp=at, parent_frame_id=parent, child_frame_id=child, translation=translation, rotation=rotation
    )


def _entity(at: fg.Timestamp, name: str, lifetime_s: int = 0, frame: str = BODY, **parts: Any) -> fg.SceneEntity:
    """Replaces the entity of the same name. With a lifetime of 0 it stays until then."""
    lifetime = fg.Duration(lifetime_s, 0)
    return fg.SceneEntity(timestamp=at, frame_id=frame, id=name, lifetime=lifetime, frame_locked=True, **parts)


def _cylinder(pose: fg.Pose, size: fg.Vector3, colour: fg.Color) -> fg.CylinderPrimitive:
    return fg.CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=colour)


def _shape(known: ObjectSpec | None, place: Vec3, colour: fg.Color) -> tuple[str, Any]:
    """The field of a SceneEntity that an object's shape belongs to, and the shape."""
    pose = _pose(place)
    x, y, z = known.size_m if known is not None else (0.06, 0.06, 0.06)
    size = fg.Vector3(x=x, y=y, z=z)
    if known is not None and known.shape == "cylinder":
        return "cylinders", _cylinder(pose, size, colour)
    if known is not None and known.shape == "box":
        return "cubes", fg.CubePrimitive(pose=pose, size=size, color=colour)
    return "spheres", fg.SpherePrimitive(pose=pose, size=size, color=colour)


def _by_kind(shapes: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for kind, shape in shapes:
        found.setdefault(kind, []).append(shape)
    return found


def _grid(at: fg.Timestamp, plan: FloorPlan) -> fg.Grid:
    """The floor map; one column where nothing was seen, for a grid of no columns is none."""
    x, y = plan.origin_m
    cells = CELLS[np.frombuffer(plan.cells, dtype=np.uint8)] if plan.cells else CELLS[:1]
    byte = fg.PackedElementFieldNumericType.Uint8
    fields = [
        fg.PackedElementField(name=name, offset=n, type=byte)
        for n, name in enumerate(("red", "green", "blue", "alpha"))
    ]
    columns = max(plan.width, 1)
    return fg.Grid(
        timestamp=at, frame_id=MAP, pose=_pose((x, y, 0.0)), column_count=columns,
        cell_size=fg.Vector2(x=plan.cell_m, y=plan.cell_m), row_stride=4 * columns, cell_stride=4, fields=fields,
        data=cells.tobytes(),
    )  # fmt: skip


def _way(at: fg.Timestamp, plan: FloorPlan) -> fg.SceneEntity:
    """The planned way and its goal; empty where there is none, which takes away the one before."""
    parts: dict[str, Any] = {}
    if len(plan.way_m) > 1:
        ends = [fg.Point3(x=x, y=y, z=0.02) for x, y in plan.way_m]
        line = fg.LinePrimitive(
            type=fg.LinePrimitiveLineType.LineStrip, pose=_pose((0.0, 0.0, 0.0)), thickness=0.03, points=ends,
            color=PLANNED,
        )  # fmt: skip
        parts["lines"] = [line]
    if plan.goal_m is not None:
        size = fg.Vector3(x=0.12, y=0.12, z=0.01)
        parts["cylinders"] = [_cylinder(_pose((*plan.goal_m, 0.01)), size, PLANNED)]
    return _entity(at, "planned", frame=MAP, **parts)


def for_json(value: Any) -> Any:
    """JSON has no bytes: their length stands in their place."""
    if isinstance(value, dict):
        return {str(name): for_json(item) for name, item in value.items()}
    if isinstance(value, list):
        return [for_json(item) for item in value]
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return value
