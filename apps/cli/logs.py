"""`cocoro logs`: the log files of a robot's processes, merged by time."""

from __future__ import annotations

import asyncio
import heapq
import os
import re
import sys
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TextIO

import typer

from apps.cli import completions, exits
from apps.cli.interrupt import elapsed, interrupt_event
from apps.cli.options import JsonOption, RobotOption
from apps.cli.output import print_json
from apps.cli.terminal import folded, output_width
from cocoro.errors import ConfigError, choice_of
from cocoro.private import default_run_dir
from deploy.processes import components
from deploy.rundir import RunDir, folders
from deploy.which_robot import up_here

LOOK_S = 0.2
"""Time between two looks for new lines."""
PROCESS_WIDTH = 10
"""Columns of the process's name on a terminal; a longer name takes more."""
LEVELS = ("debug", "info", "warning", "error", "critical")
_STAMP = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)[.,](\d{3}) +(\w+) ")
_HEAD = re.compile(_STAMP.pattern + r" *([\w-]+): (.*)", re.DOTALL)
_CRASHES = ("Traceback (most recent call last)", "Fatal Python error")
"""First lines of crashes, which Python writes without a level; they count as critical."""


class LogEntry(NamedTuple):
    """A line with a time, and the lines without one that follow it (a traceback, for example)."""

    stamp: str
    """Time as text that sorts; the previous entry's when the first lines of a file have none."""
    level: str
    """Lower case; empty for lines without a level."""
    lines: tuple[str, ...]

    def data(self) -> dict[str, Any]:
        """The entry for scripts. The process is empty for lines without a time."""
        first, *rest = self.lines
        match = _HEAD.match(first)
        process, text = (match[5], match[6]) if match else ("", first)
        return {"time": self.stamp, "level": self.level, "process": process, "text": text, "more": rest}

    def shown(self, width: int) -> Iterator[str]:
        """The entry for a terminal of that width: no date, no level but one above info, long lines folded."""
        match = _HEAD.match(self.lines[0])
        if match is None:
            yield from self.lines
            return
        level = "" if match[4].lower() in ("info", "debug") else f"{match[4]}: "
        head = f"{match[2]}.{match[3]} {match[5]:<{PROCESS_WIDTH}} "
        yield from folded(head, f"{level}{match[6]}", width)
        yield from self.lines[1:]


def robot_of(robot: str | None) -> RunDir:
    """Run directory of the robot, up or not. Raises ConfigError when several have logs, or none."""
    if robot is not None:
        run_dir = up_here(robot)
        if not run_dir.logs.is_dir():
            raise ConfigError(f"there are no logs of {robot} in {run_dir.logs}")
        return run_dir
    found = [run_dir for run_dir in folders() if run_dir.logs.is_dir()]
    up = [run_dir for run_dir in found if run_dir.populated]
    if len(up or found) == 1:
        return (up or found)[0]
    if not found:
        raise ConfigError(f"there are no logs in {default_run_dir()}: no robot has been up here (`cocoro up sim`)")
    raise ConfigError(f"logs of several robots; choose one: {', '.join(f'--robot {r.robot}' for r in up or found)}")


def files_of(run_dir: RunDir, name: str | None) -> list[Path]:
    """Log files of all processes, or of the process or service `name`. Raises ConfigError for an unknown name."""
    known = {path.name.removesuffix(".log"): path for path in sorted(run_dir.logs.glob("*.log"))}
    if name is None:
        return list(known.values())
    process = name if name in known else _process_of(run_dir, name)
    if process not in known:
        raise ConfigError(f"{run_dir.robot} has no log of {name}; {choice_of(name, known)}")
    return [known[process]]


def _process_of(run_dir: RunDir, service: str) -> str:
    """Name of the process that is a service: the one that runs now, else by the profile of the last start."""
    if service in (claims := run_dir.claims()):
        return claims[service].name
    started = run_dir.resolved().get("processes", ())
    rows = [row for row in components() if service in row.services]
    return next((row.name for row in rows if row.name in started), rows[0].name if rows else service)


def entries(lines: Iterable[str], stamp: str = "") -> Iterator[LogEntry]:
    """Groups lines into entries; `stamp` is the time of the entry before them."""
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
    """Reads one log file as it grows, and the file that replaces it when the process starts again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: TextIO | None = None
        self._stamp = ""
        self._part = ""

    def read(self) -> list[LogEntry]:
        """The entries that are new. A last line without its newline waits for the next call."""
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


app = typer.Typer()


@app.command()
def logs(
    service: Annotated[
        str | None, typer.Argument(help="A process or a service; all by default.", autocompletion=completions.services)
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Print new entries, too, until Ctrl-C.")] = False,
    lines: Annotated[int, typer.Option("--lines", "-n", min=0, help="Number of newest entries to begin with.")] = 100,
    level: Annotated[
        str | None,
        typer.Option(
            metavar="LEVEL",
            autocompletion=completions.of(*LEVELS),
            help="Only this level and above: debug, info, warning, error.",
        ),
    ] = None,
    robot: RobotOption = None,
    json: JsonOption = False,
) -> None:
    """Logs of the robot's processes on this machine since their start, merged by time. Works when it is down.

    A terminal gets times without the date; a file or a pipe gets the lines as they were logged.
    """
    sys.exit(asyncio.run(print_logs(robot, service, follow, lines, level, json)))


async def print_logs(
    robot: str | None, name: str | None, follow: bool, count: int, level: str | None, as_json: bool = False
) -> int:
    """Prints the newest `count` entries, and with `follow` new ones until interrupted; returns the exit code.

    Raises ConfigError for an unknown level, robot or name.
    """
    if level is not None and level not in LEVELS:
        raise ConfigError(f"--level {level}: {choice_of(level, LEVELS)}")
    run_dir = robot_of(robot)
    wanted = {*LEVELS, ""} if level is None else set(LEVELS[LEVELS.index(level) :])
    tails = {path: LogTail(path) for path in files_of(run_dir, name)}
    show = _Printer(as_json)
    try:
        show(deque(_chosen(tails.values(), wanted), maxlen=count))
        if follow:
            with interrupt_event() as end:
                while await elapsed(end, LOOK_S):
                    if name is None:
                        tails |= {path: LogTail(path) for path in files_of(run_dir, None) if path not in tails}
                    show(_chosen(tails.values(), wanted))
    finally:
        for tail in tails.values():
            tail.close()
    return exits.DONE


def _chosen(tails: Iterable[LogTail], wanted: set[str]) -> Iterator[LogEntry]:
    """New entries of all logs that have a wanted level, in the order of time."""
    merged = heapq.merge(*(tail.read() for tail in tails), key=lambda entry: entry.stamp)
    return (entry for entry in merged if entry.level in wanted)


class _Printer:
    """Prints entries as JSON, fitted to a terminal, or as they were logged; on a terminal with a line for each day."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._day = ""

    def __call__(self, found: Iterable[LogEntry]) -> None:
        for entry in found:
            if self._as_json:
                print_json(entry.data())
            elif sys.stdout.isatty():
                if (day := entry.stamp.partition("T")[0]) != self._day:
                    self._day = day
                    print(f"--- {day}")
                print(*entry.shown(output_width()), sep="\n", flush=True)
            else:
                print(*entry.lines, sep="\n", flush=True)
