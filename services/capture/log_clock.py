"""The clock of log times: Unix time at the start of the recording, advanced by a clock that cannot be set
(CLOCK_BOOTTIME)."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import NamedTuple

import msgspec

from cocoro.clock import NS, steady_ns

WALL_CLOCK = "wall_clock"
"""Metadata record with the steps of the wall clock during the recording."""
STEP_NS = NS // 100
"""A smaller offset is not a step of the wall clock: the two clocks are read one after the other."""
TOGETHER_NS = NS // 1000
"""Two readings that took longer than this are useless for a comparison."""
TRIES = 3
KEPT_STEPS = 100


class WallClockStep(msgspec.Struct, frozen=True):
    """The wall clock was set."""

    log_ns: int
    """Log time at which the step was noticed."""
    by_s: float
    """Positive: forward."""


class _Reading(NamedTuple):
    offset_ns: int
    """Wall clock minus boot time."""
    apart_ns: int
    """Bound of the offset's error."""


class LogClock:
    """Gives messages their log times by `at`. `look` must be called regularly, to notice steps of the wall clock."""

    def __init__(self, wall_ns: Callable[[], int] = time.time_ns, steady_ns: Callable[[], int] = steady_ns) -> None:
        self._wall_ns = wall_ns
        self._steady_ns = steady_ns
        self._start = self._newest = min((self._read() for _ in range(TRIES)), key=lambda reading: reading.apart_ns)
        self._steps: list[WallClockStep] = []
        self._count = 0

    def at(self, steady_ns: int) -> int:
        """The log time of a message that arrived at this time of `cocoro.clock.steady_ns`, both in ns."""
        return steady_ns + self._start.offset_ns

    def now_ns(self) -> int:
        return self.at(self._steady_ns())

    def look(self) -> WallClockStep | None:
        """The step of the wall clock since the last call; None without a step, or when the readings are too far apart
        to tell."""
        reading = self._read()
        by_ns = reading.offset_ns - self._newest.offset_ns
        if reading.apart_ns > TOGETHER_NS or abs(by_ns) < STEP_NS:
            return None
        step = WallClockStep(self.now_ns(), by_ns / NS)
        self._newest = reading
        self._steps = [*self._steps, step][-KEPT_STEPS:]
        self._count += 1
        return step

    def metadata(self) -> dict[str, str]:
        """The record `WALL_CLOCK`, to be written after each step."""
        return {
            "steps": json.dumps(msgspec.to_builtins(self._steps)),
            "count": str(self._count),
            "ahead_of_log_s": repr((self._newest.offset_ns - self._start.offset_ns) / NS),
        }

    def _read(self) -> _Reading:
        before_ns = self._steady_ns()
        wall_ns = self._wall_ns()
        after_ns = self._steady_ns()
        return _Reading(wall_ns - (before_ns + after_ns) // 2, after_ns - before_ns)


def describe_step(step: WallClockStep) -> str:
    return f"set {'forward' if step.by_s > 0 else 'back'} by {abs(step.by_s):.3f} s"
