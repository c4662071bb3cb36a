"""Perception's pure core: turns frames and head angles into detections, fused by the frame's stamp."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cocoro.arrays import Float32Array, FloatArray
from cocoro.core import Output, Sample, Schedule, Take
from cocoro.history import History
from cocoro.messages import Detections, Frame, Obstacles, ServoState
from cocoro.objects import Catalogue
from cocoro.robot import Camera, Robot
from cocoro.topics import ARM_STATE, DETECTIONS, FRAME, OBSTACLES, Topic
from services.perception.blob import BlobDetector
from services.perception.colour_alone import ColourLocaliser
from services.perception.colour_floor import ColourFloorScanner
from services.perception.config import PerceptionConfig
from services.perception.floor import FloorScanner
from services.perception.image import Detector, ImageSighting, RgbdImage
from services.perception.localise import Localiser
from services.perception.paper import PaperDetector

NS = 1_000_000_000
MAX_PENDING = 8
"""Frames that may wait for head angles. Beyond it the oldest is published without positions."""

DETECTORS: dict[str, Callable[[Catalogue, PerceptionConfig], Detector]] = {"blob": BlobDetector, "paper": PaperDetector}


@dataclass(frozen=True)
class _Pending:
    """The sightings of one frame, which waits for the head angles of its stamp. Its pixels are not kept."""

    stamp_ns: int
    frame_seq: int
    frame_incarnation: int
    camera: Camera
    sightings: tuple[ImageSighting, ...]
    floor_depth_m: Float32Array | None
    """What the floor's scanner has taken from the picture, shape (rows, columns); None when no floor scan is due."""
    nearest: bytes
    """As in `Obstacles`, of the same image."""
    deadline_ns: int


class PerceptionCore:
    """Detects when a frame arrives, and localises with the head angles interpolated at the frame's stamp.

    A frame whose stamp is newer than the arm's last state waits, at most `bracket_wait_s`; then its detections are
    published without positions. Detections are published in the order of their frames.
    """

    def __init__(self, robot: Robot, config: PerceptionConfig, catalogue: Catalogue) -> None:
        self._robot = robot
        self._config = config
        self._detector: Detector = DETECTORS[config.detector](catalogue, config)
        localiser, scanner = (Localiser, FloorScanner) if robot.sees_depth else (ColourLocaliser, ColourFloorScanner)
        self._localiser = localiser(robot, catalogue, config.occluded_share)
        self._head = History(len(self._localiser.joints))
        self._max_gap_ns = round(config.max_head_gap_s * NS)
        self._pending: deque[_Pending] = deque()
        self._floor = scanner(robot, config)
        self._floor_period: int | None = None
        self._now_ns = 0
        self.stale_frames = 0
        """Frames that were ignored because they were too old."""
        self.unlocalised_frames = 0
        """Frames whose detections were published without head angles."""

    @property
    def reads(self) -> Mapping[Topic[Any], Take]:
        return {FRAME: "latest", ARM_STATE: "all"}

    @property
    def schedule(self) -> Schedule:
        return Schedule(rate_hz=None, triggers=(FRAME, ARM_STATE))

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        if now_ns < self._now_ns:  # the clock restarted: the earlier epoch's data are meaningless
            self._pending.clear()
            self._head.clear()
            self._floor_period = None
        self._now_ns = now_ns
        for sample in inputs:
            if isinstance(sample.message, ServoState):
                self._remember(sample.message)
        for sample in inputs:
            if isinstance(sample.message, Frame):
                self._look(sample.message, now_ns)
        return self._release(now_ns)

    def _remember(self, state: ServoState) -> None:
        self._floor.watch(state)
        angles = dict(zip(state.joints, state.position_rad, strict=True))
        if self._localiser.joints and all(joint in angles for joint in self._localiser.joints):
            head = [angles[joint] for joint in self._localiser.joints]
            self._head.add(state.stamp_ns, head, state.incarnation)

    def _look(self, frame: Frame, now_ns: int) -> None:
        if now_ns - frame.stamp_ns > self._config.max_frame_age_s * NS:
            self.stale_frames += 1
            return
        image = RgbdImage.of(frame, self._robot)
        floor_due = self._floor_due(frame.stamp_ns)
        self._pending.append(
            _Pending(
                stamp_ns=frame.stamp_ns,
                frame_seq=frame.seq,
                frame_incarnation=frame.incarnation,
                camera=image.camera,
                sightings=tuple(self._detector.detect(image)),
                floor_depth_m=self._floor.sample(image) if floor_due else None,
                nearest=self._floor.nearest(image) if floor_due else b"",
                deadline_ns=now_ns + round(self._config.bracket_wait_s * NS),
            )
        )

    def _release(self, now_ns: int) -> list[Output]:
        outputs = []
        while self._pending:
            pending = self._pending[0]
            angles = self._head_at(pending.stamp_ns)
            if angles is None and self._may_still_come(pending, now_ns):
                break
            self._pending.popleft()
            outputs.append(Output(DETECTIONS, self._localised(pending, angles)))
            if angles is not None and pending.floor_depth_m is not None:
                outputs.append(Output(OBSTACLES, self._scanned(pending, angles)))
        return outputs

    def _head_at(self, stamp_ns: int) -> FloatArray | None:
        """The angles of the head's joints at a time, rad; None where they are not known. A camera that is fixed on the
        body has none, and they are always known."""
        return self._head.at(stamp_ns, self._max_gap_ns) if self._localiser.joints else np.zeros(0)

    def _floor_due(self, stamp_ns: int) -> bool:
        """The first frame of each period by the clock: which frames these are does not depend on earlier ones for
        long, so that a core that begins in the middle of a run soon does the same."""
        edge = 0.01  # of a period, so that frames of just this rate are not at its edges
        period = math.floor(stamp_ns * self._config.floor_rate_hz / NS - edge)
        due, self._floor_period = period != self._floor_period, period
        return due

    def _scanned(self, pending: _Pending, angles: FloatArray) -> Obstacles:
        assert pending.floor_depth_m is not None
        camera, pose = pending.camera, self._localiser.camera_pose(angles)
        scan = self._floor.scan(pending.floor_depth_m, camera.width, camera.height, pose)
        scan.stamp_ns, scan.nearest = pending.stamp_ns, pending.nearest
        return scan

    def _may_still_come(self, pending: _Pending, now_ns: int) -> bool:
        newest = self._head.newest
        passed = newest is not None and newest[0] >= pending.stamp_ns
        return not passed and now_ns < pending.deadline_ns and len(self._pending) <= MAX_PENDING

    def _localised(self, pending: _Pending, angles: FloatArray | None) -> Detections:
        if angles is None:
            self.unlocalised_frames += 1
        head = dict(zip(self._localiser.joints, angles.tolist(), strict=True)) if angles is not None else {}
        pan_rad, tilt_rad = (head[name] for name in self._robot.head_joints) if head else (None, None)
        return Detections(
            stamp_ns=pending.stamp_ns,
            frame_seq=pending.frame_seq,
            frame_incarnation=pending.frame_incarnation,
            width=pending.camera.width,
            height=pending.camera.height,
            pan_rad=pan_rad,
            tilt_rad=tilt_rad,
            detections=tuple(self._localiser.locate(pending.sightings, pending.camera, angles)),
        )
