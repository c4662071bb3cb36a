"""`--foxglove`: an MCAP file of Foxglove's well-known schemas, which it opens as they are.

Its time is the robot's: log times and times within are the messages' stamps. Beside the well-known ones, every
other message is there as JSON under its own key, to be plotted.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np

from apps.captures.export import foxglove_types as fg
from apps.captures.export.files import making
from apps.captures.export.geometry import CAMERA, Posture, about_z, conjugate, points, quaternion, rotated
from apps.captures.export.story import catalogue_of, robot_of
from apps.captures.rewrite import info_in
from cocoro.capture.mcap import DamageError
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import JSON, NotReadableError
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
from cocoro.picture import describe
from cocoro.units import Vec3
from services.capture.file import Packer
from services.capture.keys import KeyInfo, QueuedMessage
from services.capture.writer import CaptureWriter, Limits

ODOMETRY, BODY = "odometry", "body"
"""Names of frames; the links' are their own."""
DEPTH_STEP = 4
"""Of the depth image, every so many rows and columns become points."""
LATE_NS = 2 * NS
"""How much later than others a message may be recorded and still be put where its stamp belongs."""
JPEG_QUALITY = 90
WHITE, BLACK, BONE = fg.Color(1, 1, 1), fg.Color(0, 0, 0, 0.6), fg.Color(0.85, 0.85, 0.9)
TRUE = fg.Color(0.2, 0.9, 0.3, 0.45)


class Said(NamedTuple):
    """One message of the new file."""

    topic: str
    message: msgspec.Struct | dict[str, Any]
    channel: int | None = None
    """The recorded one; None where it is told in Foxglove's own terms."""


def export(capture: Capture, out: Path, progress: Callable[[float], None] = lambda _: None) -> int:
    """Returns how many messages were written. Raises CaptureError when that cannot be done."""
    with making(out):
        return _export(capture, out, progress)


def _export(capture: Capture, out: Path, progress: Callable[[float], None]) -> int:
    translator = Translator(capture)
    writer = CaptureWriter(lambda _: out, Packer("zstd"), Limits(), lambda *_: KeyInfo(JSON, None, {}))
    newest_ns = 0
    for stamp_ns, said in _by_stamp(capture, translator, progress):
        newest_ns = max(newest_ns, stamp_ns)
        payload = msgspec.json.encode(said.message)
        writer.put(QueuedMessage(said.topic, 0, newest_ns, newest_ns, payload, translator.info_of(said), said.channel))
    writer.close()
    return writer.messages


def _by_stamp(
    capture: Capture, translator: Translator, progress: Callable[[float], None]
) -> Iterator[tuple[int, Said]]:
    """In order of the stamps, as far as messages are not recorded too late for that."""
    waiting: list[tuple[int, int, Record]] = []
    stamp_ns = _first_stamp_ns(capture)
    for number, record in enumerate(capture.messages()):
        if _stamped(record):
            stamp_ns = record.publish_ns
        heapq.heappush(waiting, (stamp_ns, number, record))
        while record.log_ns - waiting[0][2].log_ns > LATE_NS:
            at_ns, _, due = heapq.heappop(waiting)
            yield from ((at_ns, said) for said in translator.translate(due))
        progress((record.log_ns - capture.start_ns) / NS)
    while waiting:
        at_ns, _, due = heapq.heappop(waiting)
        yield from ((at_ns, said) for said in translator.translate(due))


def _first_stamp_ns(capture: Capture) -> int:
    return next((record.publish_ns for record in capture.messages() if _stamped(record)), 0)


def _stamped(record: Record) -> bool:
    """A message without a stamp was recorded with the time of its receipt, and is put beside its neighbour."""
    return record.publish_ns != record.log_ns


class Translator:
    """What Foxglove is told of each message."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._robot = robot_of(capture)
        self._catalogue = catalogue_of(capture)
        self._posture = Posture(self._robot)
        self._phase = ""

    def translate(self, record: Record) -> Iterator[Said]:
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
            yield Said(record.key, _for_json(plain), record.channel)

    def info_of(self, said: Said) -> KeyInfo:
        """A recorded channel keeps its own schema; its bytes are given by their number."""
        if said.channel is not None:
            return info_in(self._capture, said.channel)._replace(encoding=JSON, metadata={})
        return KeyInfo(JSON, fg.schema_of(type(said.message)), {})

    # --- what is shown ----------------------------------------------------------------------------

    def _shown(self, message: Message) -> Iterator[Said]:
        at = fg.time_of(message.stamp_ns)
        if isinstance(message, BaseState):
            self._posture.move(message)
            yield Said("/tf", fg.FrameTransforms([self._body(at)]))
            yield Said("/robot", fg.SceneUpdate([self._chassis(at)]))
        elif isinstance(message, ServoState):
            self._posture.bend(message)
            yield from self._links(at)
        elif isinstance(message, Detections):
            yield Said("/camera/annotations", self._annotations(at, message))
        elif isinstance(message, PlannerStatus):
            believed = [self._object(at, "believed", known) for known in message.known]
            yield Said("/believed", fg.SceneUpdate(believed))
        elif isinstance(message, TaskState):
            yield from self._log(at, message)
        elif isinstance(message, Truth):
            yield Said("/truth", fg.SceneUpdate([self._true(at, message)]))

    def _frame(self, frame: Frame) -> Iterator[Said]:
        at = fg.time_of(frame.stamp_ns)
        pixels = np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)
        _, jpeg = cv2.imencode(
            ".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        )
        yield Said("/camera/colour", fg.CompressedImage(at, CAMERA, jpeg.tobytes(), "jpeg"))
        camera = self._robot.camera.scaled(frame.width, frame.height)
        k = (camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0)
        r = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
        p = (*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0)
        yield Said(
            "/camera/calibration",
            fg.CameraCalibration(at, CAMERA, frame.width, frame.height, "", (), k, r, p),
        )
        places, colours = points(frame, self._robot, DEPTH_STEP)
        packed = np.zeros(len(places), dtype=[("place", "<f4", 3), ("colour", "u1", 3), ("alpha", "u1")])
        packed["place"], packed["colour"], packed["alpha"] = places, colours, 255
        fields = [fg.PackedElementField(name, 4 * n, fg.FLOAT32) for n, name in enumerate("xyz")]
        fields += [fg.PackedElementField(n, 12 + i, fg.UINT8) for i, n in enumerate(("red", "green", "blue", "alpha"))]
        cloud = fg.PointCloud(at, CAMERA, fg.pose_of((0.0, 0.0, 0.0)), 16, tuple(fields), packed.tobytes())
        yield Said("/camera/points", cloud)

    def _body(self, at: fg.Time) -> fg.FrameTransform:
        body = self._posture.body
        turn = fg.Quaternion(*about_z(body.yaw_rad))
        return fg.FrameTransform(at, ODOMETRY, BODY, fg.Vector3(body.x_m, body.y_m, 0.0), turn)

    def _chassis(self, at: fg.Time) -> fg.SceneEntity:
        base = self._robot.base
        size = fg.Vector3(base.chassis_diameter_m, base.chassis_diameter_m, base.chassis_height_m)
        pose = fg.pose_of((0.0, 0.0, base.chassis_height_m / 2))
        return fg.SceneEntity(
            timestamp=at, frame_id=BODY, id="chassis", cylinders=[fg.CylinderPrimitive(pose, size, 1.0, 1.0, BONE)]
        )

    def _links(self, at: fg.Time) -> Iterator[Said]:
        links = self._posture.links()
        if not links:
            return
        transforms = [
            fg.FrameTransform(
                at, BODY, name, fg.Vector3(*map(float, pose[:3, 3])), fg.Quaternion(*quaternion(pose[:3, :3]))
            )
            for name, pose in links.items()
        ]
        yield Said("/tf", fg.FrameTransforms(transforms))
        ends = [fg.Vector3(*place) for bone in self._posture.bones(links) for place in bone]
        origin = fg.pose_of((0.0, 0.0, 0.0))
        line = fg.LinePrimitive(fg.LINE_LIST, origin, 0.02, False, ends, BONE, [], [])
        yield Said("/robot", fg.SceneUpdate([fg.SceneEntity(timestamp=at, frame_id=BODY, id="links", lines=[line])]))

    def _annotations(self, at: fg.Time, seen: Detections) -> fg.ImageAnnotations:
        boxes, texts = [], []
        for detection in seen.detections:
            left, top, right, bottom = map(float, detection.box_px)
            colour = self._colour(detection.label)
            corners = [fg.Point2(x, y) for x, y in ((left, top), (right, top), (right, bottom), (left, bottom))]
            nothing = fg.Color(0, 0, 0, 0)
            boxes.append(
                fg.PointsAnnotation(
                    timestamp=at,
                    type=fg.LINE_LOOP,
                    points=corners,
                    outline_color=colour,
                    fill_color=nothing,
                    thickness=2,
                )
            )
            texts.append(
                fg.TextAnnotation(
                    timestamp=at, position=fg.Point2(left, top), text=describe(detection), font_size=14,
                    text_color=WHITE, background_color=BLACK,
                )
            )  # fmt: skip
        return fg.ImageAnnotations(boxes, texts)

    def _object(self, at: fg.Time, prefix: str, known: TargetEstimate) -> fg.SceneEntity:
        x, y, z = known.position_m
        words = f"{known.label}, {known.age_s:.1f} s ago" if known.age_s > 0.5 else known.label
        text = fg.TextPrimitive(fg.pose_of((x, y, z + 0.1)), True, 0.04, False, WHITE, words)
        entity = fg.SceneEntity(timestamp=at, frame_id=BODY, id=f"{prefix} {known.label}", texts=[text])
        entity.lifetime = fg.Duration(1, 0)
        _add_shape(entity, self._catalogue.get(known.label), known.position_m, self._colour(known.label))
        return entity

    def _true(self, at: fg.Time, truth: Truth) -> fg.SceneEntity:
        """In the body frame, where the belief is too."""
        entity = fg.SceneEntity(timestamp=at, frame_id=BODY, id="true")
        for item in truth.objects:
            if item.kind == "object":
                x, y, z = (there - here for there, here in zip(item.position_m, truth.body_m, strict=True))
                place = rotated(conjugate(truth.body_orientation), (x, y, z))
                _add_shape(entity, self._catalogue.get(item.label), place, TRUE)
        return entity

    def _log(self, at: fg.Time, task: TaskState) -> Iterator[Said]:
        phase = f"{task.task} {task.label}: {task.outcome or task.phase}".strip()
        if task.task_id and phase != self._phase:
            level = fg.ERROR if task.outcome == "failed" else fg.INFO
            words = f"{phase} ({task.reason})" if task.reason else phase
            yield Said("/log", fg.Log(at, level, words, "executive"))
        self._phase = phase

    def _colour(self, label: str) -> fg.Color:
        known = self._catalogue.get(label)
        return fg.Color(*known.rgb) if known is not None else WHITE


def _add_shape(entity: fg.SceneEntity, known: ObjectSpec | None, place: Vec3, colour: fg.Color) -> None:
    pose = fg.pose_of(place)
    size = fg.Vector3(*(known.size_m if known is not None else (0.06, 0.06, 0.06)))
    if known is not None and known.shape == "cylinder":
        entity.cylinders.append(fg.CylinderPrimitive(pose, size, 1.0, 1.0, colour))
    elif known is not None and known.shape == "box":
        entity.cubes.append(fg.CubePrimitive(pose, size, colour))
    else:
        entity.spheres.append(fg.SpherePrimitive(pose, size, colour))


def _for_json(value: Any) -> Any:
    """JSON has no bytes and no NaN."""
    if isinstance(value, dict):
        return {str(name): _for_json(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_for_json(item) for item in value]
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return value
