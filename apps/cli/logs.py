"""`cocoro logs`: what the processes of a robot wrote, in the order in which they wrote it."""

from __future__ import annotations

import heapq
import os
import re
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, TextIO

from apps.cli import exits
from apps.cli.ending import passed, told_to_end
from cocoro.bus.endpoints import default_run_dir
from cocoro.errors import ConfigError
from deploy.processes import components
from deploy.rundir import RunDir, folders

LOOK_S = 0.2
"""How often it looks for more."""
LEVELS = ("debug", "info", "warning", "error", "critical")
_STAMP = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)[.,](\d{3}) +(\w+) ")
_CRASHES = ("Traceback (most recent call last)", "Fatal Python error")
"""Written without a level, by Python itself, and worth one."""


class LogEntry(NamedTuple):
    """What was written at once: a line with a time, and those without one that follow it (a traceback, say)."""

    stamp: str
    """Sorts by time; that of the line before when the first lines of a file have none."""
    level: str
    """Empty for lines that have none."""
    lines: tuple[str, ...]


def robot_of(robot: str | None) -> RunDir:
    """The robot whose logs are meant, up or not. Raises ConfigError when that is not clear, or there are none."""
    if robot is not None:
        run_dir = RunDir(robot)
        if not run_dir.logs.is_dir():
            raise ConfigError(f"there are no logs of {robot} in {run_dir.logs}")
        return run_dir
    found = [run_dir for run_dir in folders() if run_dir.logs.is_dir()]
    up = [run_dir for run_dir in found if run_dir.populated]
    if len(up or found) == 1:
        return (up or found)[0]
    if not found:
        raise ConfigError(f"there are no logs in {default_run_dir()}: no robot has been up here (`cocoro up sim`)")
    raise ConfigError(f"logs of several robots, say which: {', '.join(f'--robot {r.robot}' for r in up or found)}")


def files_of(run_dir: RunDir, name: str | None) -> list[Path]:
    """The logs of all processes, or that of one, by its own name or a service's. Raises ConfigError for no such one."""
    known = {path.name.removesuffix(".log"): path for path in sorted(run_dir.logs.glob("*.log"))}
    if name is None:
        return list(known.values())
    process = name if name in known else _process_of(run_dir, name)
    if process not in known:
        raise ConfigError(f"{run_dir.robot} has no log of {name}; there are {', '.join(known) or 'none'}")
    return [known[process]]


def _process_of(run_dir: RunDir, service: str) -> str:
    """The process that is a service: now, or by the last start's profile."""
    if service in (claims := run_dir.claims()):
        return claims[service].name
    started = run_dir.resolved().get("processes", ())
    rows = [row for row in components() if service in row.services]
    return next((row.name for row in rows if row.name in started), rows[0].name if rows else service)


def entries(lines: Iterable[str], stamp: str = "") -> Iterator[LogEntry]:
    """Lines as entries; `stamp` is that of what was before them."""
    level, gathered = "", list[str]()
    for line in lines:
        match = _STAMP.match(line)
        if match is not None:
            if gathered:
                yield LogEntry(stamp, level, tuple(gathered))
            stamp, level, gathered = f"{match[1]}T{match[2]}.{match[3]}", match[4].lower(), []
        elif line.startswith(_CRASHES):
            level = "critical"
        gathered.append(line)
    if gathered:
        yield LogEntry(stamp, level, tuple(gathered))


class LogTail:
    """One log, read on as it grows, and in the file that takes its place when the process starts again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: TextIO | None = None
        self._stamp = ""
        self._part = ""

    def read(self) -> list[LogEntry]:
        """What is new. A last line that has no end yet waits for it."""
        text = self._rest()
        if self._replaced():
            self.close()
            self._file = None
            text += self._rest()
        *whole, self._part = (self._part + text).split("\n")
        found = list(entries(whole, self._stamp))
        if found:
            self._stamp = found[-1].stamp
        return found

    def _rest(self) -> str:
        if self._file is None:
            try:
                self._file = self.path.open(encoding="utf-8", errors="replace")
            except FileNotFoundError:  # between two starts
                return ""
        return self._file.read()

    def _replaced(self) -> bool:
        try:
            return self._file is not None and not os.path.samestat(os.fstat(self._file.fileno()), self.path.stat())
        except FileNotFoundError:
            return False

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


async def logs(robot: str | None, name: str | None, follow: bool, count: int, level: str | None) -> int:
    """Print the newest entries, and with `follow` those that come, until interrupted."""
    if level is not None and level not in LEVELS:
        raise ConfigError(f"--level {level}: it is one of {', '.join(LEVELS)}")
    run_dir = robot_of(robot)
    wanted = {*LEVELS, ""} if level is None else set(LEVELS[LEVELS.index(level) :])
    tails = {path: LogTail(path) for path in files_of(run_dir, name)}
    try:
        _print(deque(_chosen(tails.values(), wanted), maxlen=count))
        if follow:
            with told_to_end() as end:
                while await passed(end, LOOK_S):
                    if name is None:
                        tails |= {path: LogTail(path) for path in files_of(run_dir, None) if path not in tails}
                    _print(_chosen(tails.values(), wanted))
    finally:
        for tail in tails.values():
            tail.close()
    return exits.DONE


def _chosen(tails: Iterable[LogTail], wanted: set[str]) -> Iterator[LogEntry]:
    """What is new in all of them, by time."""
    merged = heapq.merge(*(tail.read() for tail in tails), key=lambda entry: entry.stamp)
    return (entry for entry in merged if entry.level in wanted)


def _print(found: Iterable[LogEntry]) -> None:
    for entry in found:
        print(*entry.lines, sep="\n", flush=True)
