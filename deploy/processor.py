"""Use of this machine's processors, and the processes that wait for one: read from /proc, over a time.

The figures are of this machine and its other users, so they are not part of the robot's messages.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

PROC = Path("/proc")
STARVED_SHARE = 0.2
"""A process that waits for a processor for this share of a time is starved in it."""
TAKERS = 3
"""Number of processes that are named, those that take most."""
TAKES_SHARE = 0.1
"""A process is named as one that takes the processor from this share of one core on."""
WORDS = 40
"""Longest command line that is quoted, characters."""
TICK_HZ = os.sysconf("SC_CLK_TCK")


class Taker(NamedTuple):
    pid: int
    what: str
    """The robot's name of it, or its command line, without the folders of program and script."""
    share: float
    """Of one core."""


class ProcessorUse(NamedTuple):
    """The use of the processors over a time."""

    seconds: float
    cores: int
    waited: dict[str, float]
    """By process of the robot: the share of the time in which its main thread was ready to run and got no processor."""
    takers: tuple[Taker, ...]
    """The processes that took most, greatest first."""

    @property
    def starved(self) -> list[str]:
        """The robot's processes that were starved, the worst first."""
        worst = sorted(self.waited, key=self.waited.__getitem__, reverse=True)
        return [name for name in worst if self.waited[name] >= STARVED_SHARE]

    @property
    def words(self) -> str:
        """One line for people: who waited how long, and who took the processor; '' when no process was starved."""
        if not self.starved:
            return ""
        late = ", ".join(f"{name} {self.waited[name]:.0%}" for name in self.starved[:TAKERS])
        by = ", ".join(f"{taker.what} (pid {taker.pid}) {taker.share:.0%}" for taker in self.takers)
        return (
            f"this machine is short of processor time: of {self.seconds:.2g} s waited {late}; "
            f"of its {self.cores} cores took {by or 'nobody much'}"
        )


class ProcessorWatch:
    """Measures between two calls of `take`. `robot` has the robot's processes, by name, as they are at each call."""

    def __init__(self, proc: Path = PROC) -> None:
        self._proc = proc
        self._before: _Look | None = None

    def take(self, robot: Mapping[str, int]) -> ProcessorUse | None:
        """The use since the last call; None at the first one, and where /proc does not tell."""
        before, now = self._before, _look(self._proc, robot)
        self._before = now
        if before is None or now is None:
            return None
        seconds = max(now.at_s - before.at_s, 1e-3)
        waited = {
            name: min((wait_s - before.waited_s[key]) / seconds, 1.0)
            for key, wait_s in now.waited_s.items()
            if key in before.waited_s
            for name in [key[0]]
        }
        names = {pid: name for name, pid in robot.items()}
        used = {who: (cpu_s - before.used_s.get(who, 0.0)) / seconds for who, cpu_s in now.used_s.items()}
        most = sorted(used, key=used.__getitem__, reverse=True)[:TAKERS]
        takers = tuple(
            Taker(pid, names.get(pid) or _command(self._proc, pid), used[pid, start])
            for pid, start in most
            if used[pid, start] >= TAKES_SHARE
        )
        return ProcessorUse(seconds, os.cpu_count() or 1, waited, takers)


class _Look(NamedTuple):
    at_s: float
    used_s: dict[tuple[int, int], float]
    """By number and start time: processor time of every process."""
    waited_s: dict[tuple[str, int], float]
    """By name and number: the time for which a process of the robot has waited for a processor."""


def _look(proc: Path, robot: Mapping[str, int]) -> _Look | None:
    used_s = {}
    try:
        numbers = [int(name) for name in os.listdir(proc) if name.isdigit()]  # noqa: PTH208 # hundreds, so fast
    except OSError:
        return None
    for pid in numbers:
        fields = _stat(pid, proc)
        if fields is not None:
            used_s[pid, int(fields[19])] = (int(fields[11]) + int(fields[12])) / TICK_HZ
    waited_s = {}
    for name, pid in robot.items():
        try:
            waited_s[name, pid] = int((proc / str(pid) / "schedstat").read_text().split()[1]) / 1e9
        except (OSError, ValueError, IndexError):
            continue
    return _Look(time.monotonic(), used_s, waited_s) if used_s else None


def start_of(pid: int, proc: Path = PROC) -> int | None:
    """The start time of a process, in ticks since the machine's start; None when there is no such process, or it has
    ended and waits to be reaped, or /proc cannot be read."""
    fields = _stat(pid, proc)
    return None if fields is None or fields[0] in ("Z", "X") else int(fields[19])


def _stat(pid: int, proc: Path) -> list[str] | None:
    """The fields of a process's `stat` from its state on (proc(5) numbers them from 3)."""
    try:
        text = (proc / str(pid) / "stat").read_text(errors="replace")
    except OSError:
        return None
    fields = text.rpartition(")")[2].split()
    return fields if len(fields) > 19 else None


def _command(proc: Path, pid: int) -> str:
    try:
        words = (proc / str(pid) / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return "?"
    program, *arguments = (word.decode(errors="replace") for word in words)
    if arguments and arguments[0].startswith("/"):  # an interpreter's script
        arguments[0] = arguments[0].rpartition("/")[2]
    line = " ".join(filter(None, (program.rpartition("/")[2], *arguments)))
    printable = "".join(c if c.isprintable() else " " for c in line)
    return printable if len(printable) <= WORDS else f"{printable[: WORDS - 1]}…"
