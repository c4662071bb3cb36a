"""The register of a mesh on one machine: a directory with one held file (see `cocoro.held_file`) per member.

Members register one after another, under the directory's lock, and each connects to all that are registered already:
so every pair is connected exactly once, by the later one. A member that dies loses its lock; the next process that
looks removes its entry. A command can also visit without an entry (needed when the disk is full): it connects to the
members, and members that come later do not connect to it.

The directory is this user's alone (see `cocoro.private`). An entry counts only if it is a regular file of this user
that is held and has a valid name and number in it (or nothing yet).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cocoro import private
from cocoro.errors import ConfigError
from cocoro.held_file import HeldFile, hold, holder_of

ENTRY = ".member"
SOCKET = ".sock"
DIRECTORY_LOCK = "lock"
LOCK_PATIENCE_S = 0.25
"""Upper bound for the wait for the directory's lock, s. It is held for a few file operations; a holder that takes
longer has been stopped. Joining then goes on without the lock, since an emergency stop must get through; the price is
that some pairs are connected twice."""
_ENTRY = rf"([0-9a-f]{{16}}){re.escape(ENTRY)}"


class Member(NamedTuple):
    identity: str
    """16 hexadecimal digits, the zenoh id; unique to the process."""
    name: str
    pid: int
    """0 when the disk had no room for the number."""


class Membership:
    """One process's place in the register. `leave` gives it back; so does the end of the process."""

    def __init__(self, directory: Path, member: Member, others: list[Member], entry: HeldFile | None) -> None:
        self.member = member
        self.others = others
        """The members that were registered before; the later one connects."""
        self._directory = directory
        self._entry = entry
        self._registered = entry is not None

    @classmethod
    def register(cls, directory: Path, name: str) -> Membership:
        """Raises ConfigError when the directory is not this user's alone, FullError when it takes no more entries."""
        member = Member(new_identity(), name, os.getpid())
        with private.directory(directory, make=True) as fd, _locked(directory) as locked:
            # First register, then look: so of two that do both at the same time, at least one sees the other.
            entry = hold(directory / (member.identity + ENTRY), name, named=False)
            others = [other for other in _living(fd, tidy=locked) if other.identity != member.identity]
        return cls(directory, member, others, entry)

    @classmethod
    def visit(cls, directory: Path, name: str) -> Membership:
        """Connects to the members without being registered: later members do not connect to it. Raises ConfigError when
        the directory is not this user's alone."""
        return cls(directory, Member(new_identity(), name, os.getpid()), members(directory), None)

    @property
    def listen(self) -> list[str]:
        return [endpoint(self._directory, self.member)] if self._registered else []

    @property
    def connect(self) -> list[str]:
        return [endpoint(self._directory, other) for other in self.others]

    def leave(self) -> None:
        entry, self._entry = self._entry, None
        if entry is not None:
            with contextlib.suppress(OSError, ConfigError), private.directory(self._directory) as fd:
                _remove(fd, self.member.identity)
            entry.release()


def members(directory: Path) -> list[Member]:
    """Members of the mesh; none without its directory. Raises ConfigError when that is not this user's alone."""
    try:
        with private.directory(directory) as fd, _locked(directory) as locked:
            return _living(fd, tidy=locked)
    except FileNotFoundError:
        return []


def endpoint(directory: Path, member: Member) -> str:
    return f"unixsock-stream/{directory / (member.identity + SOCKET)}"


def new_identity() -> str:
    """16 random hexadecimal digits."""
    return f"{int.from_bytes(os.urandom(8)) | 1 << 63:016x}"  # zenoh takes no leading zeros


@contextlib.contextmanager
def _locked(directory: Path) -> Iterator[bool]:
    """Holds the directory's lock if it can be had within `LOCK_PATIENCE_S`; yields whether it is held."""
    try:
        lock_fd = private.open_file(directory / DIRECTORY_LOCK, os.O_CREAT | os.O_RDWR)
    except private.FullError:
        yield False
        return
    try:
        yield _flock_within(lock_fd, LOCK_PATIENCE_S)
    finally:
        os.close(lock_fd)


def _flock_within(fd: int, patience_s: float) -> bool:
    deadline_s = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() > deadline_s:
                return False
            time.sleep(0.001)  # a blocking flock has no time-out, and the holder may have been stopped


def _living(directory_fd: int, tidy: bool) -> list[Member]:
    """The entries that are held. With `tidy` (under the directory's lock) the entries of dead members are removed."""
    found = []
    for name in sorted(os.listdir(directory_fd)):
        match = re.fullmatch(_ENTRY, name)
        fd = None if match is None else _open_entry(directory_fd, name)
        if match is None or fd is None:
            continue
        try:
            by = holder_of(fd)
            if by is None:
                if tidy:
                    _remove(directory_fd, match[1])
            elif by.known:
                found.append(Member(match[1], by.name, by.pid))
            elif os.fstat(fd).st_size == 0:  # just made, or the disk had no room for the name
                found.append(Member(match[1], "?", 0))
        finally:
            os.close(fd)
    return found


def _open_entry(directory_fd: int, name: str) -> int | None:
    """Opens an entry to look at it; None when it has just been removed, or is no regular file of this user."""
    try:
        fd = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=directory_fd)
    except OSError as error:
        if error.errno in (errno.EMFILE, errno.ENFILE):
            raise
        return None
    status = os.fstat(fd)
    if stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid():
        return fd
    os.close(fd)
    return None


def _remove(directory_fd: int, identity: str) -> None:
    for suffix in (ENTRY, SOCKET, SOCKET + ".lock"):
        with contextlib.suppress(FileNotFoundError, IsADirectoryError):
            os.unlink(identity + suffix, dir_fd=directory_fd)
