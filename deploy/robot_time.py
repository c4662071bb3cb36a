"""The robot's time on this machine: one offset from `cocoro.clock.steady_ns` to wall time, fixed when the robot starts.

It is the first eight bytes of the file `clock` in the robot's run directory, which every process of the robot maps into
its memory and reads each time. The supervisor fixes it at its start from the wall clock. Without a supervisor, the
first process of the mesh does. A file from another boot of the machine or another time namespace is ignored. A process
without a valid file measures its own offset; its time then differs from that of the others by the steps of the wall
clock since, and readers reject its commands if that makes them too old or too far ahead.

On a site each host has such a file, and the gateway compares its time with that of another host and corrects it
(`deploy.site.timekeeping`): at once as long as no other process has started, and later by slewing. The file says which.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import MutableSequence
from contextlib import suppress
from pathlib import Path

from cocoro import private
from cocoro.clock import RealClock, wall_offset_ns
from cocoro.errors import ConfigError

FILE = "clock"
SETTABLE, OWN, COMPARED, ALONE = range(4)
"""How the offset came about: just fixed, and nothing reads it yet but the gateway; rightly this machine's own; set by
the host that keeps the robot's time; this machine's own because that host did not answer."""
_CELLS = struct.Struct("=qq")
"""The offset in nanoseconds, and how it came about; after them the boot that they are valid for."""
LONGEST = 4096
"""Upper bound of the file's size, bytes."""


def fix(folder: Path, *, settable: bool = False) -> RealClock:
    """Fixes the robot's time from the present wall clock, for all later processes. `settable`: the gateway may yet set
    it. Raises ConfigError, FullError."""
    cells = _CELLS.pack(wall_offset_ns(), SETTABLE if settable else OWN)
    private.write(folder / FILE, cells + _boot())
    return clock(folder)


def clock(folder: Path) -> RealClock:
    """The robot's clock as it was fixed; a clock with its own offset when there is no valid file."""
    with suppress(OSError, ConfigError, ValueError):
        return RealClock(_cells(folder, write=False))
    return RealClock()


def setting(folder: Path) -> Setting:
    """For the gateway, which corrects it. Fixes it anew when there is no valid file. Raises ConfigError, FullError."""
    with suppress(OSError, ConfigError, ValueError):
        return Setting(_cells(folder, write=True))
    fix(folder)
    return Setting(_cells(folder, write=True))


class Setting:
    """The robot's time on this machine as its gateway corrects it. Make it with `setting`."""

    def __init__(self, cells: MutableSequence[int] | memoryview[int]) -> None:
        """`cells`: the offset in nanoseconds, and how it came about."""
        self._cells = cells

    @property
    def offset_ns(self) -> int:
        return self._cells[0]

    @property
    def settable(self) -> bool:
        """Whether the offset may be set at once, because nothing else reads it yet."""
        return self._cells[1] == SETTABLE

    def correct(self, offset_ns: int) -> None:
        """Sets the offset; one store, which readers see whole."""
        self._cells[0] = offset_ns

    def begin(self, origin: int) -> None:
        """From now on other processes may read the offset, so it is only slewed. `origin`: how it came about."""
        self._cells[1] = origin


def origin(folder: Path) -> int:
    """How the present offset came about."""
    with suppress(OSError, ConfigError, ValueError):
        return _cells(folder, write=False)[1]
    return OWN


def _cells(folder: Path, *, write: bool) -> memoryview[int]:
    """The file's numbers, mapped. Raises ValueError for a file that is damaged or of another boot."""
    fd = private.open_file(folder / FILE, os.O_RDWR if write else os.O_RDONLY)
    try:
        length = os.fstat(fd).st_size
        if not _CELLS.size <= length <= LONGEST:
            raise ValueError(f"{folder / FILE} has {length} bytes")
        mapped = mmap.mmap(fd, length, access=mmap.ACCESS_WRITE if write else mmap.ACCESS_READ)
    finally:
        os.close(fd)
    if mapped[_CELLS.size :] != _boot():
        raise ValueError(f"{folder / FILE} is of another boot")
    return memoryview(mapped)[: _CELLS.size].cast("q")


def _boot() -> bytes:
    """The boot of the machine and the time namespace."""
    parts = []
    with suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
    with suppress(OSError):
        parts.append(str(Path("/proc/self/ns/time").readlink()))
    return " ".join(parts).encode()
