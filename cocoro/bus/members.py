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

from cocoro.errors import ConfigError, MeshError

ENTRY = ".member"
SOCKET = ".sock"
DIRECTORY_LOCK = "lock"
LOCK_PATIENCE_S = 1.0
"""The directory's lock is held for a few file operations; who holds it longer has been stopped in the middle."""


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
        with _locked(directory):
            others = _living(directory)
            member = Member(new_identity(), name, os.getpid())
            entry = directory / (member.identity + ENTRY)
            lock_fd = os.open(entry, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
            fcntl.flock(lock_fd, fcntl.LOCK_EX)
            os.write(lock_fd, json.dumps({"name": name, "pid": member.pid}).encode())
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
    with _locked(directory):
        return _living(directory)


def endpoint(directory: Path, member: Member) -> str:
    return f"unixsock-stream/{directory / (member.identity + SOCKET)}"


def new_identity() -> str:
    """16 random hexadecimal digits."""
    return f"{secrets.randbits(63) | 1 << 63:016x}"  # zenoh takes no leading zeros


def _make_private(directory: Path) -> None:
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = directory.stat()
    except OSError as error:
        raise ConfigError(f"mesh directory {directory}: {error.strerror}; choose another run directory") from error
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        raise ConfigError(
            f"mesh directory {directory}: it must be a directory that only this user can write to; "
            f"put that right or choose another run directory"
        )


@contextlib.contextmanager
def _locked(directory: Path) -> Iterator[None]:
    lock_fd = os.open(directory / DIRECTORY_LOCK, os.O_CREAT | os.O_RDWR, 0o600)
    try:
        deadline_s = time.monotonic() + LOCK_PATIENCE_S
        while True:
            try:
                fcntl.flock(lock_fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline_s:
                    raise MeshError(
                        f"mesh directory {directory}: some process has held its lock for {LOCK_PATIENCE_S:g} s; "
                        f"is one of the mesh's processes stopped?"
                    ) from None
                time.sleep(0.001)
        yield
    finally:
        os.close(lock_fd)


def _living(directory: Path) -> list[Member]:
    """Under the directory's lock. Removes what dead members left."""
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
            about = json.loads(os.read(fd, 4096))
            found.append(Member(identity, about["name"], about["pid"]))
        else:
            _remove(directory, identity)
        finally:
            os.close(fd)
    return found


def _remove(directory: Path, identity: str) -> None:
    for suffix in (ENTRY, SOCKET, SOCKET + ".lock"):
        (directory / (identity + suffix)).unlink(missing_ok=True)
