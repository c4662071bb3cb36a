"""A serial port that is none: a pseudo-terminal under a name of its own, that can be unplugged."""

from __future__ import annotations

import os
import pty
import termios
import tty
from contextlib import suppress
from pathlib import Path

from cocoro import private

BAUDS = {
    getattr(termios, f"B{baud}"): baud
    for baud in (300, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400, 500000, 1000000, 2000000)
}


class Port:
    """A driver opens `path`; this end reads and writes what goes over the wire."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._ends: tuple[int, int] | None = None
        self.plug()

    def plug(self) -> None:
        """Put the adapter in; nothing when it is in."""
        if self._ends is not None:
            return
        ours, theirs = pty.openpty()
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        self._ends = ours, theirs  # theirs stays open, or the first reader's leaving would look like unplugging
        fresh = f".{self.path.name}.{os.getpid()}"
        with private.directory(self.path.parent, make=True) as folder:
            with suppress(FileNotFoundError):
                os.unlink(fresh, dir_fd=folder)
            os.symlink(os.ttyname(theirs), fresh, dir_fd=folder)
            os.replace(fresh, self.path.name, src_dir_fd=folder, dst_dir_fd=folder)

    def unplug(self) -> None:
        """Pull the adapter out: who has the port open sees it hang up."""
        if self._ends is None:
            return
        ends, self._ends = self._ends, None
        with suppress(FileNotFoundError):
            self.path.unlink()
        for end in ends:
            os.close(end)

    close = unplug

    def fileno(self) -> int:
        """-1 while it is unplugged."""
        return -1 if self._ends is None else self._ends[0]

    @property
    def baud(self) -> int:
        """To which the driver set the port."""
        if self._ends is None:
            return 0
        return BAUDS.get(termios.tcgetattr(self._ends[0])[4], 0)

    def read(self) -> bytes:
        if self._ends is None:
            return b""
        try:
            return os.read(self._ends[0], 4096)
        except (BlockingIOError, OSError):
            return b""

    def write(self, data: bytes) -> None:
        """What nobody reads is lost when the line is full."""
        if self._ends is not None and data:
            with suppress(BlockingIOError, OSError):
                os.write(self._ends[0], data)
