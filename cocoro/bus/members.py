"""The register of a mesh on one machine: a directory in which every member holds a lock for as long as it lives.

Members register one after another (the directory has a lock for that), and each connects to all that are there
already: so any two are connected, exactly once, by the later one. A member that dies, however, loses its lock with
its life, and the next one to look tidies up after it. Where no entry can be made any more, a command can still visit:
it connects, and is not connected to.

The directory is this user's alone (see `cocoro.private`). An entry that is no regular file of this user's, or that is
held by something that did not write what a member writes, is none.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import re
import secrets
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec
from msgspec import Meta

from cocoro import private
from cocoro.errors import ConfigError

ENTRY = ".member"
SOCKET = ".sock"
DIRECTORY_LOCK = "lock"
LOCK_PATIENCE_S = 0.25
"""The directory's lock is held for a few file operations; who holds it longer has been stopped in the middle. Then
we go on without: an emergency stop must get through, and the price is that some are connected twice."""
_ENTRY = re.compile(rf"([0-9a-f]{{16}}){re.escape(ENTRY)}")


class Who(msgspec.Struct, frozen=True):
    """What a file says of the process that holds it."""

    name: str
    pid: Annotated[int, Meta(ge=1, lt=2**31)]

    @classmethod
    def of(cls, data: bytes) -> Who | None:
        """None when nothing of the kind is written there."""
        try:
            return _DECODER.decode(data)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return None


_DECODER = msgspec.json.Decoder(Who)


class Member(NamedTuple):
    identity: str
    """16 hexadecimal digits, the zenoh id; no two processes have the same one."""
    name: str
    pid: int
    """0 when the member had no room to write it down."""


class Membership:
    """One process's place in the register. `leave` gives it back; the death of the process does so too."""

    def __init__(self, directory: Path, member: Member, others: list[Member], lock_fd: int | None) -> None:
        self.member = member
        self.others = others
        """Who was there before; the later one connects."""
        self._directory = directory
        self._lock_fd = lock_fd
        self._registered = lock_fd is not None

    @classmethod
    def register(cls, directory: Path, name: str) -> Membership:
        """Raises ConfigError when the directory is not this user's alone, FullError when it takes no more entries."""
        member = Member(new_identity(), name, os.getpid())
        with private.directory(directory, make=True) as fd, _locked(directory) as locked:
            # First be there, then look who else is: so of two that look at once, one at least sees the other.
            entry = directory / (member.identity + ENTRY)
            lock_fd = private.open_file(entry, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
            fcntl.flock(lock_fd, fcntl.LOCK_EX)
            with contextlib.suppress(OSError):  # where there is no room, an entry without a name is one, too
                os.write(lock_fd, json.dumps({"name": name, "pid": member.pid}).encode())
            others = [other for other in _living(fd, tidy=locked) if other.identity != member.identity]
        return cls(directory, member, others, lock_fd)

    @classmethod
    def visit(cls, directory: Path, name: str) -> Membership:
        """Connect to those who are there, without being in the register: who comes later does not connect. Raises
        ConfigError when the directory is not this user's alone."""
        return cls(directory, Member(new_identity(), name, os.getpid()), members(directory), None)

    @property
    def listen(self) -> list[str]:
        return [endpoint(self._directory, self.member)] if self._registered else []

    @property
    def connect(self) -> list[str]:
        return [endpoint(self._directory, other) for other in self.others]

    def leave(self) -> None:
        lock_fd, self._lock_fd = self._lock_fd, None
        if lock_fd is not None:
            with contextlib.suppress(OSError, ConfigError), private.directory(self._directory) as fd:
                _remove(fd, self.member.identity)
            os.close(lock_fd)


def members(directory: Path) -> list[Member]:
    """Who is in the mesh now; nobody when there is no such directory. Raises ConfigError when it is not this user's."""
    try:
        with private.directory(directory) as fd, _locked(directory) as locked:
            return _living(fd, tidy=locked)
    except FileNotFoundError:
        return []


def endpoint(directory: Path, member: Member) -> str:
    return f"unixsock-stream/{directory / (member.identity + SOCKET)}"


def new_identity() -> str:
    """16 random hexadecimal digits."""
    return f"{secrets.randbits(63) | 1 << 63:016x}"  # zenoh takes no leading zeros


@contextlib.contextmanager
def _locked(directory: Path) -> Iterator[bool]:
    """Gives whether the lock could be had."""
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
            time.sleep(0.001)  # flock itself would wait for ever, and who holds it may have been stopped


def _living(directory_fd: int, tidy: bool) -> list[Member]:
    """Who holds an entry. Under the directory's lock, what the dead have left can be tidied away."""
    found = []
    for name in sorted(os.listdir(directory_fd)):
        match = _ENTRY.fullmatch(name)
        fd = None if match is None else _open_entry(directory_fd, name)
        if match is None or fd is None:
            continue
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            data = os.pread(fd, 4096, 0)
            who = Who.of(data)
            if who is not None:
                found.append(Member(match[1], who.name, who.pid))
            elif not data:  # it has just come, or had no room for its name
                found.append(Member(match[1], "?", 0))
        else:
            if tidy:
                _remove(directory_fd, match[1])
        finally:
            os.close(fd)
    return found


def _open_entry(directory_fd: int, name: str) -> int | None:
    """An entry to look at; None for one that left just now, or is none of this user's."""
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
