"""An emulated serial line: a pseudo-terminal that can be unplugged, and disturbances of the bytes on it."""

from __future__ import annotations

import os
import pty
import termios
import tty
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Literal

from cocoro import private

BAUDS = {
    getattr(termios, f"B{baud}"): baud
    for baud in (300, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200, 230400, 500000, 1000000, 2000000)
}


class PseudoSerialPort:
    """A pseudo-terminal. A driver opens it at `path`; this object is the other end of the wire."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._ends: tuple[int, int] | None = None
        self.plug()

    def plug(self) -> None:
        """Plug the adapter in, unless it is."""
        if self._ends is not None:
            return
        ours, theirs = pty.openpty()
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        # Theirs stays open: otherwise a driver that closes the port would look like an unplugged adapter.
        self._ends = ours, theirs
        fresh = f".{self.path.name}.{os.getpid()}"
        with private.directory(self.path.parent, make=True) as folder:
            with suppress(FileNotFoundError):
                os.unlink(fresh, dir_fd=folder)
            os.symlink(os.ttyname(theirs), fresh, dir_fd=folder)
            os.replace(fresh, self.path.name, src_dir_fd=folder, dst_dir_fd=folder)

    def unplug(self) -> None:
        """Unplug the adapter: the port hangs up for the process that has it open."""
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
        """The baud rate that the driver has set; 0 while unplugged."""
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
        """Write bytes. When the line is full because nobody reads, they are lost."""
        if self._ends is not None and data:
            with suppress(BlockingIOError, OSError):
                os.write(self._ends[0], data)


FaultKind = Literal["lost", "corrupted", "truncated", "late", "repeated", "silent"]
Direction = Literal["to_device", "to_driver", "both"]
KINDS: tuple[FaultKind, ...] = ("lost", "corrupted", "truncated", "late", "repeated", "silent")


@dataclass(frozen=True)
class LineFault:
    """A disturbance of a share of the bytes (lost, corrupted) or of the bursts (the other kinds), until a time."""

    kind: FaultKind
    share: float
    way: Direction
    until_ns: int
    delay_ns: int = 30_000_000
    """Delay of late bursts."""


class Disturbance:
    """The disturbances in one direction of a line. All draws come from the seed."""

    def __init__(self, way: Direction, seed: int) -> None:
        self._way = way
        self._draws = Random(f"{way} {seed}")
        self._faults: list[LineFault] = []
        self._late: list[tuple[int, bytes]] = []

    def add(self, fault: LineFault) -> None:
        if fault.way in (self._way, "both"):
            self._faults.append(fault)

    def clear(self) -> None:
        self._faults.clear()

    def carry(self, data: bytes, now_ns: int) -> bytes:
        """Send bytes now; returns the bytes that arrive now, which may include delayed ones. The order is kept."""
        self._faults = [fault for fault in self._faults if fault.until_ns > now_ns]
        due_ns = now_ns
        for fault in self._faults if data else ():
            hit = self._draws.random() < fault.share
            if fault.kind == "late" and hit:
                due_ns = now_ns + fault.delay_ns
            else:
                data = self._suffer(fault, data, hit)
        if data:
            self._late.append((max(due_ns, self._late[-1][0] if self._late else 0), data))
        arrived = b""
        while self._late and self._late[0][0] <= now_ns:
            arrived += self._late.pop(0)[1]
        return arrived

    def _suffer(self, fault: LineFault, data: bytes, hit: bool) -> bytes:
        draws = self._draws
        if fault.kind == "lost":
            return bytes(byte for byte in data if draws.random() >= fault.share)
        if fault.kind == "corrupted":
            return bytes(byte ^ draws.randrange(1, 256) if draws.random() < fault.share else byte for byte in data)
        if fault.kind == "silent":
            return b""
        if fault.kind == "truncated" and hit:
            return data[: draws.randrange(len(data))]
        if fault.kind == "repeated" and hit:
            return data + data
        return data
