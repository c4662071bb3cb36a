"""`--foxglove`: an MCAP file that Foxglove opens as it is, by Foxglove's own schemas (foxglove-sdk, an extra).

Log times are the messages' stamps, so time is the robot's. Every recorded message is in the file as JSON as well, on a
topic named as its key, so that it can be plotted.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np

from apps.captures.export import geometry
from apps.captures.export.files import making
from apps.captures.export.story import PhaseNews, catalogue_of, robot_of
from apps.captures.rewrite import info_in
from apps.pictures import describe
from cocoro.capture.conventions import CaptureError
from cocoro.capture.mcap import DamageError
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import JSON, NotReadableError, TypeSchema
from cocoro.clock import NS
from cocoro.messages import (
    BaseState,
    Detections,
    Frame,
    Message,
    PlannerStatus,
    ServoState,
    TargetEstimate,
    TaskState,
    Truth,
)
from cocoro.objects import ObjectSpec
from cocoro.units import Vec3
from services.capture.keys import KeyInfo, QueuedMessage
from services.capture.packing import Packer
from services.capture.writer import CaptureWriter, FileLimits

try:
    from foxglove import messages as fg
except ModuleNotFoundError as error:
    raise CaptureError("--foxglove needs foxglove-sdk: pip install 'cocoro-mesh[foxglove]'") from error

ODOMETRY, BODY = "odometry", "body"
"""Names of coordinate frames; each link's frame has the link's name."""
DEPTH_STEP = 4
"""Every so many rows and columns of the depth image become points."""
POINT_STEP_M = 2.0**-10
"""Points are rounded to this, a fifth of the sensor's step at 1.5 m: then the compression finds what is equal."""
LATE_NS = 2 * NS
"""A message may be recorded this much later than others and is still sorted in by its stamp."""
JPEG_QUALITY = 90
PACK_LEVEL = 6
"""Of zstd; an export has more time than a recording."""


def _colour(red: float, green: float, blue: float, alpha: float = 1.0) -> fg.Color:
    return fg.Color(r=red, g=green, b=blue, a=alpha)


WHITE, BLACK, BONE = _colour(1, 1, 1), _colour(0, 0, 0, 0.6), _colour(0.85, 0.85, 0.9)
TRUE, NOTHING = _colour(0.2, 0.9, 0.3, 0.45), _colour(0, 0, 0, 0)


class FoxgloveMessage(NamedTuple):
    """One message of the new file."""

    topic: str
    message: Any
    """One of Foxglove's types, or plain data of a recorded message."""
    channel: int | None = None
    """The number of the recorded channel; None for Foxglove's types."""


def export(capture: Capture, out: Path, progress: Callable[[float], None] = lambda _: None) -> int:
    """Write the file. Returns the number of messages in it. Raises CaptureError when it cannot be written.

    `progress` is called with the seconds of the capture that are done.
    """
    with making(out):
        return _export(capture, out, progress)


def _export(capture: Capture, out: Path, progress: Callable[[float], None]) -> int:
    translator = Translator(capture)
    writer = CaptureWriter(lambda _: out, Packer("zstd", PACK_LEVEL), FileLimits(), lambda *_: KeyInfo(JSON, None, {}))
    newest_ns = 0
    for stamp_ns, made in _by_stamp(capture, translator, progress):
        newest_ns = max(newest_ns, stamp_ns)
        payload = msgspec.json.encode(made.message) if made.channel is not None else made.message.encode()
        info = translator.info_of(made)
        writer.put(QueuedMessage(made.topic, 0, newest_ns, newest_ns, payload, info, made.channel))
    writer.close()
    return writer.messages


def _by_stamp(
    capture: Capture, translator: Translator, progress: Callable[[float], None]
) -> Iterator[tuple[int, FoxgloveMessage]]:
    """Stamp and message, in the order of stamps for messages that are recorded less than LATE_NS late."""
    waiting: list[tuple[int, int, Record]] = []
    stamp_ns = _first_stamp_ns(capture)
    for number, record in enumerate(capture.messages()):
        if _stamped(record):
            stamp_ns = record.publish_ns
        heapq.heappush(waiting, (stamp_ns, number, record))
        while record.log_ns - waiting[0][2].log_ns > LATE_NS:
            at_ns, _, due = heapq.heappop(waiting)
            yield from ((at_ns, made) for made in translator.translate(due))
        progress((record.log_ns - capture.start_ns) / NS)
    while waiting:
        at_ns, _, due = heapq.heappop(waiting)
        yield from ((at_ns, made) for made in translator.translate(due))


def _first_stamp_ns(capture: Capture) -> int:
    return next((record.publish_ns for record in capture.messages() if _stamped(record)), 0)


def _stamped(record: Record) -> bool:
    """A message without a stamp was recorded with its log time as publish time; it is put beside its neighbour."""
    return record.publish_ns != record.log_ns


class Translator:
    """Makes Foxglove's messages of recorded ones."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._robot = robot_of(capture)
        self._catalogue = catalogue_of(capture)
        self._posture = geometry.Posture(self._robot)
        self._phases = PhaseNews()
        self._has_chassis = False
        self._cloud_ns = -geometry.POINTS_PERIOD_NS
        """Stamp of the newest cloud of points."""

    def translate(self, record: Record) -> Iterator[FoxgloveMessage]:
        try:
            message = self._capture.read(record)
        except NotReadableError:
            message = None
        if isinstance(message, Frame):
            yield from self._frame(message)
            return
        if isinstance(message, Message):
            yield from self._shown(message)
        try:
            plain = self._capture.decode(record)
        except DamageError:
            return
        if isinstance(plain, dict):
            yield FoxgloveMessage(record.key, _for_json(plain), record.channel)

    def info_of(self, made: FoxgloveMessage) -> KeyInfo:
        """A recorded channel keeps its schema; its payloads are JSON, with the length in place of bytes."""
        if made.channel is not None:
            return info_in(self._capture, made.channel)._replace(encoding=JSON, metadata={})
        schema = made.message.get_schema()
        return KeyInfo(schema.encoding, TypeSchema(schema.name, schema.encoding, schema.data), {})

    # --- what is shown ----------------------------------------------------------------------------

    def _shown(self, message: Message) -> Iterator[FoxgloveMessage]:
        at = _time(message.stamp_ns)
        if isinstance(message, BaseState):
            self._posture.move(message)
            yield FoxgloveMessage("/tf", fg.FrameTransforms(transforms=[self._body(at)]))
            if not self._has_chassis:
                self._has_chassis = True
                yield FoxgloveMessage("/robot/chassis", fg.SceneUpdate(entities=[self._chassis(at)]))
        elif isinstance(message, ServoState):
            self._posture.bend(message)
            yield from self._links(at)
        elif isinstance(message, Detections):
            yield FoxgloveMessage("/camera/annotations", self._annotations(at, message))
        elif isinstance(message, PlannerStatus):
            believed = [self._believed(at, known) for known in message.known]
            yield FoxgloveMessage("/believed", fg.SceneUpdate(entities=believed))
        elif isinstance(message, TaskState):
            yield from self._log(at, message)
        elif isinstance(message, Truth):
            yield FoxgloveMessage("/truth", fg.SceneUpdate(entities=[self._true(at, message)]))

    def _frame(self, frame: Frame) -> Iterator[FoxgloveMessage]:
        at = _time(frame.stamp_ns)
        pixels = np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)
        _, jpeg = cv2.imencode(
            ".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        )
        picture = fg.CompressedImage(timestamp=at, frame_id=geometry.CAMERA, data=jpeg.tobytes(), format="jpeg")
        yield FoxgloveMessage("/camera/colour", picture)
        camera = self._robot.camera.scaled(frame.width, frame.height)
        k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
        calibration = fg.CameraCalibration(
            timestamp=at, frame_id=geometry.CAMERA, width=frame.width, height=frame.height, K=k,
            R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], P=[*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0],
        )  # fmt: skip
        yield FoxgloveMessage("/camera/calibration", calibration)
        if 0 <= frame.stamp_ns - self._cloud_ns < geometry.POINTS_PERIOD_NS:
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
            timestamp=at, frame_id=geometry.CAMERA, pose=_pose((0.0, 0.0, 0.0)), point_stride=16, fields=fields,
            data=packed.tobytes(),
        )  # fmt: skip
        yield FoxgloveMessage("/camera/points", cloud)

    def _body(self, at: fg.Timestamp) -> fg.FrameTransform:
        body = self._posture.body
        return _transform(at, ODOMETRY, BODY, (body.x_m, body.y_m, 0.0), geometry.about_z(body.yaw_rad))

    def _chassis(self, at: fg.Timestamp) -> fg.SceneEntity:
        base = self._robot.base
        size = fg.Vector3(x=base.chassis_diameter_m, y=base.chassis_diameter_m, z=base.chassis_height_m)
        chassis = _cylinder(_pose((0.0, 0.0, base.chassis_height_m / 2)), size, BONE)
        return _entity(at, "chassis", cylinders=[chassis])

    def _links(self, at: fg.Timestamp) -> Iterator[FoxgloveMessage]:
        links = self._posture.links()
        if not links:
            return
        transforms = [
            _transform(at, BODY, name, tuple(map(float, pose[:3, 3])), geometry.quaternion(pose[:3, :3]))
            for name, pose in links.items()
        ]
        yield FoxgloveMessage("/tf", fg.FrameTransforms(transforms=transforms))
        ends = [fg.Point3(x=x, y=y, z=z) for bone in self._posture.bones(links) for x, y, z in bone]
        line = fg.LinePrimitive(
            type=fg.LinePrimitiveLineType.LineList, pose=_pose((0.0, 0.0, 0.0)), thickness=0.02, points=ends, color=BONE
        )
        yield FoxgloveMessage("/robot/links", fg.SceneUpdate(entities=[_entity(at, "links", lines=[line])]))

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

    def _log(self, at: fg.Timestamp, task: TaskState) -> Iterator[FoxgloveMessage]:
        if words := self._phases.told_by(task):
            level = fg.LogLevel.Error if task.outcome == "failed" else fg.LogLevel.Info
            yield FoxgloveMessage("/log", fg.Log(timestamp=at, level=level, message=words, name="executive"))

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


def _entity(at: fg.Timestamp, name: str, lifetime_s: int = 0, **parts: Any) -> fg.SceneEntity:
    """Replaces the entity of the same name. With a lifetime of 0 it stays until then."""
    lifetime = fg.Duration(lifetime_s, 0)
    return fg.SceneEntity(timestamp=at, frame_id=BODY, id=name, lifetime=lifetime, frame_locked=True, **parts)


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


def _for_json(value: Any) -> Any:
    """JSON has no bytes: their length stands in their place."""
    if isinstance(value, dict):
        return {str(name): _for_json(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_for_json(item) for item in value]
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return value
