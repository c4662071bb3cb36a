"""The emergency stop's latch on disk: one small file a service, made and filled before anything moves.

The file never grows, so a full disk does not matter; it is written in place and synced. Who cannot read its record
counts as latched. The files of a robot lie in `<state>/<robot>/latch/`, where <state> is the first of
$COCORO_STATE_DIR, /var/lib/cocoro where it is this user's (the unit file makes it so), $XDG_STATE_HOME/cocoro and
~/.local/state/cocoro: a place that outlives a reboot, unlike the run directory, and that does not change with who
starts the robot, the unit file or the user by hand.
"""

from __future__ import annotations

import json
import os
import threading
import time
import zlib
from collections.abc import Iterable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

STATE_DIR = "COCORO_STATE_DIR"
"""Environment variable with the place of what must outlive a reboot."""
MACHINES = Path("/var/lib/cocoro")
"""The place of a robot that starts with its machine."""
RECORD_BYTES = 512
"""One sector of a disk: it is written whole or not at all."""
_BY_CHARACTERS = 60
_FLAGS = os.O_NOFOLLOW | os.O_CLOEXEC


class Said(NamedTuple):
    """What a record says."""

    latched: bool
    by: str
    when: str = ""
    """Wall time, for people."""


def state_dir() -> Path:
    """Where a robot's state lives that must outlive a reboot."""
    if explicit := os.environ.get(STATE_DIR):
        return Path(explicit).absolute()
    with suppress(OSError):
        if MACHINES.stat().st_uid == os.geteuid():
            return MACHINES
    if state := os.environ.get("XDG_STATE_HOME"):
        return Path(state) / "cocoro"
    return Path(os.path.expanduser("~")) / ".local" / "state" / "cocoro"  # noqa: PTH111 # Path's raises without a home


def latch_dir(robot: str) -> Path:
    return state_dir() / robot / "latch"


def prepare(folder: Path, services: Iterable[str], *, by_hand: bool) -> dict[str, Said]:
    """Make the records that are missing; what all of them say then.

    Where there is no record at all this machine never knew a latch: a start by a person's hand makes them released. A
    start that nobody watches, and a record that is missing beside others, makes them latched.
    Raises OSError when the folder cannot be made or written; its `strerror` says why.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.lstat()
    if status.st_uid != os.getuid() or status.st_mode & 0o022:
        raise PermissionError(1, "somebody else could write to it", str(folder))
    services = sorted(services)
    known = any(folder.iterdir())
    fresh = Said(False, "the first start") if by_hand and not known else None
    for service in services:
        if not os.path.lexists(folder / service):
            missing = Said(True, "its record was missing" if known else "a first start that no person watched")
            _make(folder, service, fresh or missing)
    return {service: read(folder / service) for service in services}


def read(path: Path) -> Said:
    """What a record says; one that cannot be read says that it is latched, and why."""
    try:
        fd = os.open(path, os.O_RDONLY | _FLAGS)
    except OSError as error:
        return _unreadable(path, error.strerror or str(error))
    try:
        return _understood(path, os.pread(fd, RECORD_BYTES + 1, 0))
    except OSError as error:
        return _unreadable(path, error.strerror or str(error))
    finally:
        os.close(fd)


class LatchRecord:
    """One service's record, held open: `keep` needs no memory, no space on the disk and no name."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.said = read(path)
        """What it says, or will when the disk has taken it."""
        self.last: Future[str] = Future()
        """The newest write: why it is not on the disk, or '' when it is."""
        self.last.set_result("" if self.said.when else self.said.by)  # what cannot be read is not on the disk
        self._fd: int | None = None
        with suppress(OSError):
            self._fd = os.open(path, os.O_RDWR | _FLAGS)
        self._lock = threading.Lock()
        self._wanted: SimpleQueue[tuple[bytes, Future[str]]] = SimpleQueue()
        threading.Thread(target=self._write_all, name=f"latch {path.name}", daemon=True).start()

    def keep(self, latched: bool, by: str) -> Future[str]:
        """Begin to write, unless it says so already; the future tells why it is not on the disk, or '' when it is.
        From any thread."""
        with self._lock:
            failed = self.last.done() and self.last.result()
            if failed or self.said.latched != latched:
                self.said = Said(latched, by)
                self.last = Future()
                self._wanted.put((_record(self.said), self.last))
            return self.last

    def _write_all(self) -> None:
        while True:
            data, done = self._wanted.get()
            done.set_result(self._write(data))

    def _write(self, data: bytes) -> str:
        try:
            if self._fd is None or os.fstat(self._fd).st_nlink == 0:  # it was missing, or was removed meanwhile
                self._fd = _make_file(self.path, data)  # what is removed keeps its descriptor: there are few of them
            os.pwrite(self._fd, data, 0)
            if os.fstat(self._fd).st_size != RECORD_BYTES:  # it was damaged
                os.ftruncate(self._fd, RECORD_BYTES)
            os.fsync(self._fd)
        except Exception as error:  # whatever it is, the next write is tried
            return f"{self.path}: {getattr(error, 'strerror', None) or error}"
        return ""


def _record(said: Said) -> bytes:
    by = "".join(character for character in said.by if character.isprintable())[:_BY_CHARACTERS]
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    body = json.dumps({"latched": said.latched, "by": by, "when": when}, ensure_ascii=False).encode(errors="replace")
    return f"{zlib.crc32(body):08x} ".encode() + body.ljust(RECORD_BYTES - 10) + b"\n"


def _understood(path: Path, data: bytes) -> Said:
    body = data[9:-1].rstrip()
    if len(data) != RECORD_BYTES or data[-1:] != b"\n" or data[:9] != f"{zlib.crc32(body):08x} ".encode():
        return _unreadable(path, "it is damaged")
    try:
        said = json.loads(body)
        return Said(bool(said["latched"]), str(said["by"]), str(said["when"]))
    except (ValueError, TypeError, KeyError):
        return _unreadable(path, "it is of another version")


def _unreadable(path: Path, why: str) -> Said:
    return Said(True, f"the record {path}, which cannot be read: {why}")


def _make(folder: Path, service: str, said: Said) -> None:
    os.close(_make_file(folder / service, _record(said)))


def _make_file(path: Path, data: bytes) -> int:
    """A record that is there whole or not at all, also after a power cut; open for writing."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    with suppress(FileNotFoundError):
        fresh.unlink()
    fd = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_EXCL | _FLAGS, 0o600)
    try:
        os.pwrite(fd, data, 0)
        os.fsync(fd)
        fresh.replace(path)
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError:
        os.close(fd)
        with suppress(OSError):
            fresh.unlink()
        raise
    return fd
