"""Where a file is that is open: others may move or remove it meanwhile."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, NamedTuple

from cocoro.messages import DisturbedFile


class Whereabouts(NamedTuple):
    state: Literal["there", "moved", "removed"]
    path: str
    """Where it is; '' when it was removed, or when the system does not tell where it was moved."""


def whereabouts(path: Path, fd: int) -> Whereabouts:
    """Whether the file that is open as `fd` still has its path. A move to another disk is a copy and a removal, and so
    it looks here: the copy may lack what was written last."""
    mine = os.fstat(fd)
    try:
        if os.path.samestat(path.stat(), mine):
            return Whereabouts("there", str(path))
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError:  # a folder that must not be looked into, a disk that does not answer: nothing is known
        return Whereabouts("there", str(path))
    now = _name(fd, mine)
    # A network file system keeps what is removed under such a name for as long as it is open.
    if mine.st_nlink == 0 or Path(now).name.startswith(".nfs"):
        return Whereabouts("removed", "")
    return Whereabouts("moved", now)


def told(file: DisturbedFile) -> str:
    """A line for people."""
    if file.became == "removed":
        return (
            f"{file.file} was removed (or moved to another disk) while it was recorded: {file.lost} messages are lost"
        )
    where = f"to {file.now}" if file.now else "elsewhere"
    return f"{file.file} was moved {where} while it was recorded"


def _name(fd: int, mine: os.stat_result) -> str:
    """The name that the system knows a descriptor's file by; '' when that is not the file's name any more."""
    try:
        name = Path(f"/proc/self/fd/{fd}").readlink()
        return str(name) if os.path.samestat(name.stat(), mine) else ""
    except OSError:
        return ""
