"""The register of a mesh on one machine: a directory in which every member holds a lock for as long as it lives.

Members register one after another (the directory has a lock for that), and each connects to all that are there
already: so any two are connected, exactly once, by the later one. A member that dies, however, loses its lock with
its life, and the next one to look tidies up after it.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cocoro.errors import ConfigError

ENTRY = ".member"
SOCKET = ".sock"
DIRECTORY_LOCK = "lock"
LOCK_PATIENCE_S = 0.25
"""The directory's lock is held for a few file operations; who holds it longer has been stopped in the middle. Then
we go on without: an emergency stop must get through, and the price is that some are connected twice."""


class Member(NamedTuple):
    identity: str
    """16 hexadecimal digits, the zenoh id; no two processes have the same one."""
    name: str
    pid: int


class Membership:
    """One process's place in the register. `leave` gives it back; the death of the process does so too."""

    def __init__(self, directory: Path, member: Member, others: list[Member], lock_fd: int) -> None:
        self.member = member
        self.others = others
        """Who was there before; the later one connects."""
        self._directory = directory
        self._lock_fd: int | None = lock_fd

    @classmethod
    def register(cls, directory: Path, name: str) -> Membership:
        """Raises ConfigError when the directory is not this user's alone."""
        _make_private(directory)
        member = Member(new_identity(), name, os.getpid())
        with _locked(directory) as locked:
            # First be there, then look who else is: so of two that look at once, one at least sees the other.
            entry = directory / (member.identity + ENTRY)
            lock_fd = os.open(entry, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
            fcntl.flock(lock_fd, fcntl.LOCK_EX)
            os.write(lock_fd, json.dumps({"name": name, "pid": member.pid}).encode())
            others = [other for other in _living(directory, tidy=locked) if other.identity != member.identity]
        return cls(directory, member, others, lock_fd)

    @property
    def listen(self) -> str:
        return endpoint(self._directory, self.member)

    @property
    def connect(self) -> list[str]:
        return [endpoint(self._directory, other) for other in self.others]

    def leave(self) -> None:
        lock_fd, self._lock_fd = self._lock_fd, None
        if lock_fd is not None:
            _remove(self._directory, self.member.identity)
            os.close(lock_fd)


def members(directory: Path) -> list[Member]:
    """Who is in the mesh now; nobody when there is no such directory."""
    if not directory.is_dir():
        return []
    with _locked(directory) as locked:
        return _living(directory, tidy=locked)


def endpoint(directory: Path, member: Member) -> str:
    return f"unixsock-stream/{directory / (member.identity + SOCKET)}"


def new_identity() -> str:
    """16 random hexadecimal digits."""
    return f"{secrets.randbits(63) | 1 << 63:016x}"  # zenoh takes no leading zeros


def _make_private(directory: Path) -> None:
    us = os.getuid()
    try:
        directory.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        directory.mkdir(mode=0o700, exist_ok=True)
        above, status = directory.parent.stat(), directory.stat()
    except OSError as error:
        raise ConfigError(f"mesh directory {directory}: {error.strerror}; choose another run directory") from error
    ours = status.st_uid == us or us == 0
    replaceable = above.st_uid not in (0, us, status.st_uid) or above.st_mode & 0o1002 == 0o0002
    if not stat.S_ISDIR(status.st_mode) or not ours or status.st_mode & 0o022 or replaceable:
        raise ConfigError(
            f"mesh directory {directory}: it must be a directory that only this user can write to or replace; "
            f"put that right or choose another run directory"
        )


@contextlib.contextmanager
def _locked(directory: Path) -> Iterator[bool]:
    """Gives whether the lock could be had."""
    lock_fd = os.open(directory / DIRECTORY_LOCK, os.O_CREAT | os.O_RDWR, 0o600)
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


def _living(directory: Path, tidy: bool) -> list[Member]:
    """Who holds an entry. Under the directory's lock, what the dead have left can be tidied away."""
    found = []
    for entry in sorted(directory.glob("*" + ENTRY)):
        identity = entry.name.removesuffix(ENTRY)
        try:
            fd = os.open(entry, os.O_RDONLY)
        except FileNotFoundError:
            continue  # it left just now
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            about = json.loads(os.read(fd, 4096) or b"{}")
            found.append(Member(identity, about.get("name", "?"), about.get("pid", 0)))
        else:
            if tidy:
                _remove(directory, identity)
        finally:
            os.close(fd)
    return found


def _remove(directory: Path, identity: str) -> None:
    for suffix in (ENTRY, SOCKET, SOCKET + ".lock"):
        (directory / (identity + suffix)).unlink(missing_ok=True)
