"""How the body truly moved, at every step of the physics: a file for benches and tests, which no service can read.

The simulator writes it when its setting `motion` names a file. Each row is fixed-size binary, so a run that is killed
leaves a file that is whole up to its last flush, a few milliseconds before.
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
    """One step of the physics."""

    sim_ns: int
    """Simulated time at the end of the step."""
    real_ns: int
    """CLOCK_MONOTONIC at that moment: the same clock in every process of the machine."""
    speed_mps: float
    """Speed of the body's centre over the floor, by the way it came in this step."""
    rim_mps: float
    """Speed of the wheels' places about the body's centre, by how far the body turned in this step."""
    asked_mps: float
    """Speed of the faster wheel, as the base's ramp has it."""
    no_command: bool
    """The base's own deadman held the wheels."""

    @property
    def moves_mps(self) -> float:
        """The faster of going and turning."""
        return max(self.speed_mps, self.rim_mps)


class MotionWriter:
    """Told of every step. Raises ConfigError when the file cannot be written."""

    def __init__(self, path: Path, world: World) -> None:
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise ConfigError(f"motion = {str(path)!r}: {error.strerror}; name a file that can be written") from error
        self._world = world
        self._separation_m = world.robot.base.wheel_separation_m
        self._before = self._place()
        self._before_ns = world.time_ns

    def __enter__(self) -> MotionWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def step(self) -> None:
        """Write a row for the step that has just ended."""
        world = self._world
        x, y, yaw = self._place()
        dt_s = (world.time_ns - self._before_ns) / 1e9
        moved_m = hypot(x - self._before[0], y - self._before[1])
        turned_rad = abs(wrap_rad(yaw - self._before[2]))
        asked = world.wheels()
        row = (
            world.time_ns, time.monotonic_ns(), moved_m / dt_s, turned_rad * self._separation_m / 2 / dt_s,
            asked.speed_mps, asked.no_command,
        )  # fmt: skip
        self._file.write(_ROW.pack(*row))
        self._before, self._before_ns = (x, y, yaw), world.time_ns

    def flush(self) -> None:
        """Let readers have what was written."""
        self._file.flush()

    def _place(self) -> tuple[float, float, float]:
        pose = self._world.body_pose()
        return float(pose[0, 3]), float(pose[1, 3]), atan2(pose[1, 0], pose[0, 0])


def read_motion(path: Path, after: int = 0) -> list[MotionRow]:
    """The rows of a file from a row's number on, in order; what is being written when it is read is left out."""
    with path.open("rb") as file:
        file.seek(after * _ROW.size)
        data = file.read()
    whole = len(data) // _ROW.size * _ROW.size
    return [MotionRow(*row) for row in _ROW.iter_unpack(data[:whole])]
