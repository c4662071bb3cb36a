"""The robot's time on this machine: one offset from `cocoro.clock.steady_ns` to wall time, fixed when the robot starts.

It is kept in `clock.json` of the robot's run directory. The supervisor fixes it at its start; the processes that it
starts, or starts again, and the commands that join read it there. A process without a supervisor fixes it when it is
the first in the robot's mesh. A file from another boot of the machine, or from another time namespace, says nothing. A
process that finds no file that holds measures an offset of its own. Its time then differs from that of the others by
what the wall clock was stepped by since; readers reject its commands when that makes them too old, or too far ahead.

Each machine of a robot that runs on several has an offset of its own, so their wall clocks must agree when the robot
starts, to 0.1 s (NTP does that to milliseconds; `cocoro doctor` asks). Readers check it: they reject what is stamped
further ahead of them than CLOCKS_APART_NS of `cocoro.clock`, and commands that are older than their topic allows.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import msgspec

from cocoro import private
from cocoro.clock import RealClock, wall_offset_ns
from cocoro.errors import ConfigError

FILE = "clock.json"
LONGEST = 4096
"""Bytes of it that are read."""


class RobotTime(msgspec.Struct, frozen=True):
    """What is in the file."""

    boot: str
    """Which start of the machine, and which time namespace, the offset is for."""
    offset_ns: int


def fix(folder: Path) -> RealClock:
    """Fix the robot's time anew, from the wall clock as it is now, for all who come later. Raises ConfigError,
    FullError."""
    time = RobotTime(boot=_boot(), offset_ns=wall_offset_ns())
    private.write(folder / FILE, msgspec.json.encode(time))
    return RealClock(time.offset_ns)


def clock(folder: Path) -> RealClock:
    """The robot's clock as it was fixed; one of its own for this process where that is not known."""
    with suppress(OSError, ConfigError, msgspec.MsgspecError):
        time = msgspec.json.decode(private.read(folder / FILE, LONGEST), type=RobotTime)
        if time.boot == _boot():
            return RealClock(time.offset_ns)
    return RealClock()


def _boot() -> str:
    parts = []
    with suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
    with suppress(OSError):
        parts.append(str(Path("/proc/self/ns/time").readlink()))
    return " ".join(parts)
