"""The robot's time on this machine: one offset from `cocoro.clock.steady_ns` to wall time, fixed when the robot starts.

It is stored in `clock.json` of the robot's run directory. The supervisor fixes it at its start; processes and commands
read it. Without a supervisor, the first process of the mesh fixes it. A file from another boot of the machine or
another time namespace is ignored. A process without a valid file measures its own offset; its time then differs from
that of the others by the steps of the wall clock since, and readers reject its commands if that makes them too old or
too far ahead.

Each machine of a robot has its own offset, so the machines' wall clocks must agree to 0.1 s when the robot starts (NTP
does that to milliseconds; `cocoro doctor` checks it). Readers reject messages that are stamped further ahead than
CLOCKS_APART_NS of `cocoro.clock`, and commands that are older than their topic allows.
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
"""Upper bound of the file's size, bytes."""


class RobotTime(msgspec.Struct, frozen=True):
    """Content of the file."""

    boot: str
    """Boot of the machine and time namespace that the offset is valid for."""
    offset_ns: int


def fix(folder: Path) -> RealClock:
    """Fixes the robot's time from the present wall clock, for all later processes. Raises ConfigError, FullError."""
    time = RobotTime(boot=_boot(), offset_ns=wall_offset_ns())
    private.write(folder / FILE, msgspec.json.encode(time))
    return RealClock(time.offset_ns)


def clock(folder: Path) -> RealClock:
    """The robot's clock as it was fixed; a clock with its own offset when there is no valid file."""
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
