"""Collects the samples of babbling into a file and reports the progress, for the command and the rehearsal."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from math import pi
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Self

from apps.learning.dataset import HandRow, SampleFile, SampleRow, WheelRow, hand_header, wheel_header
from cocoro.errors import ConfigError
from cocoro.learning.handmap import arm_joints
from cocoro.messages import HandSample, Message, WheelTrial
from cocoro.robot import Robot
from cocoro.topics import HAND_SAMPLES, WHEEL_TRIALS, Topic
from cocoro.units import Vec3

CELL_M = 0.05


class Coverage:
    """Estimated share of the hand's positions that was seen, by cells of 5 cm (Good-Turing estimator, Good 1953).

    It is one minus the share of sightings that are alone in their cell, and needs no knowledge of the arm.
    """

    def __init__(self) -> None:
        self._cells: Counter[tuple[int, int, int]] = Counter()
        self._alone = 0
        self._count = 0

    def add(self, place_m: Vec3) -> None:
        x, y, z = (int(value // CELL_M) for value in place_m)
        self._cells[x, y, z] += 1
        self._count += 1
        self._alone += {1: 1, 2: -1}.get(self._cells[x, y, z], 0)

    @property
    def share(self) -> float:
        return 1.0 - self._alone / self._count if self._count else 0.0


class SampleCollector(ABC, Generic[SampleRow]):
    """Collects the rows of one task's babbling. Use it with `with`; raises like `SampleFile`."""

    def __init__(self, writer: SampleFile[SampleRow]) -> None:
        self._writer = writer

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)

    def __len__(self) -> int:
        return len(self._writer.rows)

    @property
    @abstractmethod
    def next(self) -> int:
        """The number of the draw or trial to continue with."""

    @property
    @abstractmethod
    def summary(self) -> str:
        """The progress in words."""

    @abstractmethod
    def take(self, message: Message) -> None:
        """Keep a reported sample; a message of another task is ignored."""


class HandCollector(SampleCollector[HandRow]):
    """Samples of the arm's babbling."""

    def __init__(self, path: Path, robot: Robot) -> None:
        self._joints, self._head = arm_joints(robot), robot.head_joints
        super().__init__(SampleFile(path, HandRow, robot, hand_header(robot, self._joints, robot.claw.level_roll_rad)))
        self._coverage = Coverage()
        for row in self._writer.rows:
            self._coverage.add(row.seen_m)

    @property
    def next(self) -> int:
        """The draw to continue with; number 0 is a corner of the range, which says little."""
        return max((row.draw + 1 for row in self._writer.rows), default=1)

    @property
    def summary(self) -> str:
        return f"{len(self)} samples, coverage {self._coverage.share:.0%}"

    def take(self, message: Message) -> None:
        if isinstance(message, HandSample):
            angles = message.angles_rad
            row = HandRow(
                stamp_ns=message.stamp_ns,
                draw=message.draw,
                angles_rad=tuple(angles[name] for name in self._joints),
                head_rad=(angles[self._head[0]], angles[self._head[1]]) if self._head else (0.0, 0.0),
                seen_m=message.seen_m,
                area_px=message.area_px,
            )
            self._writer.append([row])
            self._coverage.add(row.seen_m)


class WheelCollector(SampleCollector[WheelRow]):
    """Trials of the wheels' babbling."""

    def __init__(self, path: Path, robot: Robot, target_height_m: float | None = None) -> None:
        """`target_height_m`: height of the target's centre above the floor, if it is known."""
        self._separation_m = robot.base.axle_m
        super().__init__(SampleFile(path, WheelRow, robot, wheel_header(robot, target_height_m)))

    @property
    def next(self) -> int:
        """The trial to continue with: the first of a pair. Pair 0 is a corner of the range: both wheels back."""
        return max((row.trial // 2 * 2 + 2 for row in self._writer.rows), default=2)

    @property
    def summary(self) -> str:
        turned = sum(abs(row.turned_rad) for row in self._writer.rows)
        return f"{len(self)} trials, {turned / (2 * pi):.1f} turns in all"

    def take(self, message: Message) -> None:
        if isinstance(message, WheelTrial):
            # The base's odometry computes its turn from the wheels' travel with the nominal distance.
            half_m = message.turned_rad * self._separation_m / 2
            row = WheelRow(
                stamp_ns=message.stamp_ns,
                trial=message.trial,
                left_mps=message.left_mps,
                right_mps=message.right_mps,
                left_m=message.way_m - half_m,
                right_m=message.way_m + half_m,
                before_m=message.before_m,
                after_m=message.after_m,
                turned_rad=message.turned_rad,
                height_m=message.height_m,
            )
            self._writer.append([row])


def collector(
    samples: Topic[Any], path: Path, robot: Robot, target_height_m: float | None = None
) -> SampleCollector[Any]:
    """The collector of what is reported on a topic (`Task.samples`). `target_height_m`: height of the centre of the
    object that stands before the wheels, where it is known. Raises ConfigError for a topic that no file is made of."""
    if samples.name == HAND_SAMPLES.name:
        return HandCollector(path, robot)
    if samples.name == WHEEL_TRIALS.name:
        return WheelCollector(path, robot, target_height_m)
    raise ConfigError(f"{samples.name}: there is no file format for these samples")
