"""What capture files are called, and which have to go when there are too many."""

from __future__ import annotations

import re
from contextlib import suppress
from datetime import datetime
from pathlib import Path


def file_name(robot: str, started: datetime, number: int) -> str:
    """Of a run's nth file; names sort by time."""
    return f"{robot}-{started:%Y%m%dT%H%M%SZ}-{number:03}.mcap"


def captures(folder: Path, robot: str) -> list[Path]:
    """The files of these names, oldest first."""
    pattern = re.compile(rf"{re.escape(robot)}-\d{{8}}T\d{{6}}Z-\d{{3,}}\.mcap")
    return sorted(path for path in folder.glob("*.mcap") if pattern.fullmatch(path.name))


def make_room(folder: Path, robot: str, keep_bytes: int) -> list[Path]:
    """Delete the oldest captures until the others take no more than this; never the newest. Returns those deleted."""
    files = captures(folder, robot)
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
