"""Files that a process holds: locked (flock) for as long as it lives, with its name and number inside.

The lock ends with the process, however that ends. So a process number read from a held file is the number of that
process, never of a later one that got the same number. Used by the mesh's register and by the run directory.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from cocoro import private

LOOK_S = 1.0
"""Upper bound for one look at a lock by another process, and for a new holder to write its name, s."""
_HOLDER_BYTES = 4096
_PLAIN = rb'\{"name":"([a-z0-9_-]*)","pid":([0-9]{1,9})\}'
"""A holder as nearly all are written; it is read without the module `json`. Compiled when it is first used."""


class Holder(NamedTuple):
    """The process that holds a file."""

    name: str
    pid: int

    @property
    def known(self) -> bool:
        """False for `UNKNOWN`."""
        return self.pid > 0


UNKNOWN = Holder("", 0)
"""A holder whose name and number cannot be read."""


class HeldFile:
    """A file that this process holds. `release` lets go of it; so does the end of the process."""

    def __init__(self, fd: int) -> None:
        self._fd: int | None = fd

    def release(self) -> None:
        fd, self._fd = self._fd, None
        if fd is not None:
            with suppress(OSError):  # the next holder must not be taken for this one before it writes its name
                os.pwrite(fd, b" " * os.fstat(fd).st_size, 0)
            os.close(fd)


def hold(path: Path, name: str, *, named: bool = True) -> HeldFile | None:
    """Holds a file in the name of this process; None when another process holds it.

    Raises ConfigError when the file's directory is not this user's alone, FullError when there is no room. With
    `named=False`, a file that could be made but has no room for the name is held without one.
    """
    fd = private.open_file(path, os.O_CREAT | os.O_RDWR, make=True)
    deadline_s = time.monotonic() + LOOK_S
    while not _lock(fd, fcntl.LOCK_EX):
        if not _lock(fd, fcntl.LOCK_SH) or time.monotonic() > deadline_s:
            os.close(fd)
            return None
        # A shared lock was free: another process only looks at the file (see `holder_of`) and is done in a moment.
        fcntl.flock(fd, fcntl.LOCK_UN)
        time.sleep(os.urandom(1)[0] / 255 * 0.002)  # so that of two processes that try, one is first
    try:
        # Not truncated first: a full disk may have no room for new bytes, only for those of the last holder.
        written = os.pwrite(fd, _written(Holder(name, os.getpid())), 0)
        os.ftruncate(fd, written)
    except OSError as error:
        if named:
            os.close(fd)
            raise private.refusal(path, error) from error
    return HeldFile(fd)


def holder(path: Path) -> Holder | None:
    """The process that holds a file now; None when no process does. Raises ConfigError as `private.open_file` does."""
    try:
        fd = private.open_file(path, os.O_RDONLY)
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        return holder_of(fd, LOOK_S)
    finally:
        os.close(fd)


def holder_of(fd: int, patience_s: float = 0.0) -> Holder | None:
    """The process that holds an open file; None when no process does. `UNKNOWN` when the holder has written no valid
    name and number within `patience_s`."""
    deadline_s = time.monotonic() + patience_s
    while not _lock(fd, fcntl.LOCK_SH):
        found = _read(os.pread(fd, _HOLDER_BYTES, 0))
        if (found.known and _lives(found.pid)) or time.monotonic() >= deadline_s:
            return found if found.known else UNKNOWN
        time.sleep(0.001)  # taken this moment: the holder is about to write its name, perhaps over the last one's
    fcntl.flock(fd, fcntl.LOCK_UN)
    return None


def _written(by: Holder) -> bytes:
    import json  # here and in `_read`: a command that finds no held file does without it

    return json.dumps(by._asdict(), ensure_ascii=False, separators=(",", ":")).encode()


def _read(data: bytes) -> Holder:
    """What `_written` made; `UNKNOWN` when it is anything else."""
    if plain := re.fullmatch(_PLAIN, data):
        return Holder(plain[1].decode(), int(plain[2]))
    import json

    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        return UNKNOWN
    name, pid = (found.get("name"), found.get("pid")) if isinstance(found, dict) else (None, None)
    if isinstance(name, str) and type(pid) is int and 0 <= pid < 2**31:
        return Holder(name, pid)
    return UNKNOWN


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except OSError as error:
        return not isinstance(error, ProcessLookupError)
    return True


def _lock(fd: int, kind: int) -> bool:
    """Locks a file; False when another process's lock excludes that now."""
    try:
        fcntl.flock(fd, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
