"""What capture files are called, and which have to go when there are too many."""

from __future__ import annotations

import re
from contextlib import suppress
from datetime import datetime
from pathlib import Path


def file_name(robot: str, started: datetime, number: int) -> str:
    """Of a run's nth file; names sort by time, as the wall clock told it when the run began."""
    return f"{_run(robot, started)}-{number:03}.mcap"


def _run(robot: str, started: datetime) -> str:
    return f"{robot}-{started:%Y%m%dT%H%M%SZ}"


def captures(folder: Path, robot: str) -> list[Path]:
    """The files of these names, oldest first."""
    pattern = re.compile(rf"{re.escape(robot)}-\d{{8}}T\d{{6}}Z-\d{{3,}}\.mcap")
    return sorted(path for path in folder.glob("*.mcap") if pattern.fullmatch(path.name))


def make_room(folder: Path, robot: str, keep_bytes: int, started: datetime | None = None) -> list[Path]:
    """Delete the oldest captures until the others take no more than this; never the newest. Returns those deleted.

    The files of the run that goes on, begun at `started`, are the newest, in the order of their numbers, whatever the
    wall clock said when the others were begun.
    """
    own = "" if started is None else f"{_run(robot, started)}-"
    files = sorted(captures(folder, robot), key=lambda path: _age(path, own))
    sizes = {path: path.stat().st_size for path in files}
    left = sum(sizes.values())
    gone = []
    for path in files[:-1]:
        if left <= keep_bytes:
            break
        with suppress(OSError):
            path.unlink()
            left -= sizes[path]
            gone.append(path)
    return gone


def _age(path: Path, own: str) -> tuple[bool, int, str]:
    """Sorts the oldest first."""
    if own and path.name.startswith(own):
        return True, int(path.stem.rpartition("-")[2]), path.name
    return False, 0, path.name
