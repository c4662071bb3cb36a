"""A file with the true motion of the body at every physics step, for benches and tests.

The simulator writes it when its setting `motion` names a file. Rows have a fixed size, so a run that is killed leaves a
file that is complete up to its last flush, a few milliseconds earlier.
"""

from __future__ import annotations

import struct
import time
from math import atan2, hypot
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from cocoro.errors import ConfigError
from cocoro.frames import wrap_rad
from sim.world import World

_ROW = struct.Struct("<qqddd?")


class MotionRow(NamedTuple):
    """The body's motion in one physics step."""

    sim_ns: int
    """Simulated time at the end of the step."""
    real_ns: int
    """CLOCK_MONOTONIC at the end of the step; all processes of a machine share this clock."""
    speed_mps: float
    """Speed of the body's centre over the floor in this step."""
    rim_mps: float
    """Speed of a wheel's contact point about the body's centre, from how far the body turned in this step."""
    asked_mps: float
    """Speed of the fastest wheel by the base's ramp."""
    no_command: bool
    """Whether the base's deadman had stopped the wheels."""

    @property
    def moves_mps(self) -> float:
        """The larger of the speeds of driving and turning."""
        return max(self.speed_mps, self.rim_mps)


class MotionWriter:
    """Writes the file; call `step` after every physics step. Raises ConfigError when it cannot be written."""

    def __init__(self, path: Path, world: World) -> None:
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise ConfigError(f"motion = {str(path)!r}: {error.strerror}; name a file that can be written") from error
        self._world = world
        self._lever_m = world.robot.drive.lever_m
        self._before = self._place()
        self._before_ns = world.time_ns

    def __enter__(self) -> MotionWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def step(self) -> None:
        """Write the row of the step that has just ended."""
        world = self._world
        x, y, yaw = self._place()
        dt_s = (world.time_ns - self._before_ns) / 1e9
        moved_m = hypot(x - self._before[0], y - self._before[1])
        turned_rad = abs(wrap_rad(yaw - self._before[2]))
        wheels = world.wheels()
        row = (
            world.time_ns, time.monotonic_ns(), moved_m / dt_s, turned_rad * self._lever_m / dt_s,
            wheels.speed_mps, wheels.no_command,
        )  # fmt: skip
        self._file.write(_ROW.pack(*row))
        self._before, self._before_ns = (x, y, yaw), world.time_ns

    def flush(self) -> None:
        """Make what was written visible to readers."""
        self._file.flush()

    def _place(self) -> tuple[float, float, float]:
        pose = self._world.body_pose()
        return float(pose[0, 3]), float(pose[1, 3]), atan2(pose[1, 0], pose[0, 0])


def read_motion(path: Path, after: int = 0) -> list[MotionRow]:
    """Read the rows of a file from number `after` on, without a row that is only half written."""
    with path.open("rb") as file:
        file.seek(after * _ROW.size)
        data = file.read()
    complete = len(data) // _ROW.size * _ROW.size
    return [MotionRow(*row) for row in _ROW.iter_unpack(data[:complete])]
