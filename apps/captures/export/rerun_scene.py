"""The Rerun viewer: pictures, depth points, the robot, believed and true objects, curves and phases.

`RerunScene` logs one message at a time, from a capture (`--rrd`, `cocoro view FILE`) or live (`cocoro view`). With a
stage the simulated robot and its scene are there too, seen from outside. Needs the package rerun-sdk, an extra.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apps.captures.export import geometry
from apps.captures.export.files import making
from apps.captures.export.story import PhaseNews, catalogue_of, robot_of
from apps.pictures import describe
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.capture.types import NotReadableError
from cocoro.clock import NS
from cocoro.messages import (
    BaseCommand,
    BaseState,
    Detections,
    Frame,
    Message,
    PlannerStatus,
    ServoState,
    TaskState,
    Truth,
)
from cocoro.objects import Catalogue
from cocoro.robot import Robot

if TYPE_CHECKING:
    from apps.captures.export.rerun_stage import StageLogger
    from sim.outside import OutsideStage

APPLICATION = "cocoro"
TIMELINE = "robot"
"""Name of the time line of stamps."""
DEPTH_STEP = 5
JPEG_QUALITY = 85
BONE, UNKNOWN, TRUE = (217, 217, 230), (255, 255, 255), (50, 230, 80)


def library() -> Any:
    """The rerun package. Raises CaptureError with the command that installs it."""
    os.environ.setdefault("RUST_LOG", "off")  # its errors are raised as well, and told once
    try:
        import rerun
    except ModuleNotFoundError as error:
        raise CaptureError("this needs Rerun: pip install 'cocoro-mesh[view]'") from error
    rerun.unregister_shutdown()  # at the process's end it would wait for ever for a viewer that takes nothing
    return rerun


def export(
    capture: Capture,
    out: Path,
    progress: Callable[[float], None] = lambda _: None,
    stage: OutsideStage | None = None,
) -> int:
    """Write a recording that Rerun opens. Returns the number of messages in it. Raises CaptureError when it cannot be
    written."""
    rr = library()
    with making(out):
        recording = rr.RecordingStream(APPLICATION)
        recording.save(str(out))
        count = log_capture(capture, recording, progress, stage)
        flush(recording, out)
        return count


def flush(recording: Any, out: Path) -> None:
    """Wait until everything is in the file. Raises CaptureError when it is not."""
    try:
        recording.flush()
    except RuntimeError as error:
        raise CaptureError(f"{out}: it could not be written to its end ({error}); make room there") from error


def log_capture(
    capture: Capture,
    recording: Any,
    progress: Callable[[float], None] = lambda _: None,
    stage: OutsideStage | None = None,
) -> int:
    """Log every message of a capture to a recording. Returns their number."""
    scene = RerunScene(recording, robot_of(capture), catalogue_of(capture), stage)
    count = 0
    for record in capture.messages():
        try:
            message = capture.read(record)
        except NotReadableError:
            continue
        if isinstance(message, Message):
            scene.log(record.key.removeprefix(f"{capture.robot}/"), message)
            count += 1
        progress((record.log_ns - capture.start_ns) / NS)
    return count


class RerunScene:
    """Logs messages to a recording, at their stamps."""

    def __init__(self, recording: Any, robot: Robot, catalogue: Catalogue, stage: OutsideStage | None = None) -> None:
        self._rr = rr = library()
        self._to = recording
        self._robot = robot
        self._catalogue = catalogue
        self._posture = geometry.Posture(robot)
        self._phases = PhaseNews()
        self._why = ""
        self._cloud_ns = -geometry.POINTS_PERIOD_NS
        """Stamp of the newest cloud of points."""
        self._stage: StageLogger | None = None
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if stage is not None:
            from apps.captures.export.rerun_stage import StageLogger

            self._stage = StageLogger(rr, recording, stage)
            recording.send_blueprint(self._stage.layout())

    def log(self, topic: str, message: Message) -> None:
        """`topic` is the key without the robot's name."""
        self._to.set_time(TIMELINE, duration=message.stamp_ns / NS)
        if isinstance(message, Frame):
            self._frame(message)
        elif isinstance(message, Detections):
            self._seen(message)
        elif isinstance(message, BaseState):
            self._base(message)
        elif isinstance(message, ServoState):
            self._servos(message)
        elif isinstance(message, BaseCommand):
            self._curve("base/commanded_speed", message.ahead_mps)
            self._curve("base/commanded_turn", message.turn_radps)
        elif isinstance(message, PlannerStatus):
            self._plan(message)
        elif isinstance(message, TaskState):
            self._task(message)
        elif isinstance(message, Truth):
            self._truth(message)

    # --- what it sees -----------------------------------------------------------------------------

    def _frame(self, frame: Frame) -> None:
        rr, camera = self._rr, self._robot.camera.scaled(frame.width, frame.height)
        self._log(
            "world/body/camera",
            rr.Pinhole(
                focal_length=(camera.fx, camera.fy), principal_point=(camera.cx, camera.cy),
                width=frame.width, height=frame.height, image_plane_distance=0.2,
            ),
        )  # fmt: skip
        pixels = np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)
        self._log("world/body/camera/colour", rr.Image(pixels).compress(jpeg_quality=JPEG_QUALITY))
        if 0 <= frame.stamp_ns - self._cloud_ns < geometry.POINTS_PERIOD_NS:
            return
        self._cloud_ns = frame.stamp_ns
        places, colours = geometry.points(frame, self._robot, DEPTH_STEP)
        links = self._posture.links()
        if links:  # below the body, because entities below a camera are drawn into its picture
            pose = links[self._robot.eye.link]
            self._log(
                "world/body/points", rr.Points3D(places @ pose[:3, :3].T + pose[:3, 3], colors=colours, radii=0.004)
            )

    def _seen(self, seen: Detections) -> None:
        boxes = [detection.box_px for detection in seen.detections]
        self._log(
            "world/body/camera/colour/detections",
            self._rr.Boxes2D(
                array=np.array(boxes, dtype=np.float32).reshape(-1, 4), array_format=self._rr.Box2DFormat.XYXY,
                labels=[describe(detection) for detection in seen.detections],
                colors=[self._colour(detection.label) for detection in seen.detections],
            ),
        )  # fmt: skip

    # --- where it is ------------------------------------------------------------------------------

    def _base(self, base: BaseState) -> None:
        self._posture.move(base)
        body, rr = self._posture.body, self._rr
        self._log(
            "world/body",
            rr.Transform3D(
                translation=(body.x_m, body.y_m, 0.0), rotation=rr.Quaternion(xyzw=geometry.about_z(body.yaw_rad))
            ),
        )
        radius, height = self._robot.base.chassis_diameter_m / 2, self._robot.base.chassis_height_m
        self._log(
            "world/body/chassis",
            rr.Cylinders3D(lengths=[height], radii=[radius], centers=[(0.0, 0.0, height / 2)], colors=[BONE]),
        )
        self._curve("base/speed", base.speed_mps)
        self._curve("base/turn_rate", base.turn_rate_radps)

    def _servos(self, servos: ServoState) -> None:
        self._posture.bend(servos)
        for joint, angle_rad in zip(servos.joints, servos.position_rad, strict=True):
            self._curve(f"joints/{joint}", angle_rad)
        links = self._posture.links()
        if not links:
            return
        rr = self._rr
        self._log("world/body/links", rr.LineStrips3D(self._posture.bones(links), radii=0.01, colors=[BONE]))
        pose = links[self._robot.eye.link]
        turn = rr.Quaternion(xyzw=geometry.quaternion(pose[:3, :3]))
        self._log("world/body/camera", rr.Transform3D(translation=pose[:3, 3], rotation=turn))

    # --- what it believes, and does ---------------------------------------------------------------

    def _plan(self, plan: PlannerStatus) -> None:
        known = plan.known
        self._log(
            "world/body/believed",
            self._rr.Points3D(
                np.array([item.position_m for item in known], dtype=np.float32).reshape(-1, 3),
                labels=[item.label for item in known], radii=0.03,
                colors=[self._colour(item.label) for item in known],
            ),
        )  # fmt: skip
        if plan.hand_m is not None:
            self._log("world/body/hand", self._rr.Points3D([plan.hand_m], radii=0.015, labels=["hand"]))
        if plan.distance_m is not None:
            self._curve("distance", plan.distance_m)
        if plan.why != self._why:
            self._why = plan.why
            self._log("log", self._rr.TextLog(f"{plan.behaviour}: {plan.why}", level="DEBUG"))

    def _task(self, task: TaskState) -> None:
        if words := self._phases.told_by(task):
            self._log("log", self._rr.TextLog(words, level="ERROR" if task.outcome == "failed" else "INFO"))

    def _truth(self, truth: Truth) -> None:
        """Log the true objects in the body frame, as the believed ones are; with a stage also in the world frame."""
        if self._stage is not None:
            self._stage.log(truth)
        there = [item for item in truth.objects if item.kind == "object"]
        places = [geometry.in_body(truth, item.position_m) for item in there]
        self._log(
            "world/body/true",
            self._rr.Points3D(
                np.array(places, dtype=np.float32).reshape(-1, 3), radii=0.02, colors=[TRUE],
                labels=[f"true {item.label}" for item in there],
            ),
        )  # fmt: skip

    def _colour(self, label: str) -> tuple[int, int, int]:
        known = self._catalogue.get(label)
        if known is None:
            return UNKNOWN
        red, green, blue = (round(255 * share) for share in known.rgb)
        return red, green, blue

    def _curve(self, name: str, value: float) -> None:
        self._log(f"curves/{name}", self._rr.Scalars(value))

    def _log(self, path: str, what: Any, static: bool = False) -> None:
        self._to.log(path, what, static=static)
