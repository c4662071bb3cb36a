"""The emergency stop's latch on disk: one small file per service, made and filled before anything moves.

The file never grows, so a full disk does not matter; it is written in place and synced. A service that cannot read its
record counts as latched. The files of a robot lie in `<state>/<robot>/latch/`, where <state> is the first of
$COCORO_STATE_DIR, /var/lib/cocoro if it is this user's (the unit file makes it so), $XDG_STATE_HOME/cocoro and
~/.local/state/cocoro. Unlike the run directory these places survive a reboot, and they are the same whether the unit
file or the user starts the robot.
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
"""Environment variable with the place of state that must survive a reboot."""
MACHINES = Path("/var/lib/cocoro")
"""The place for a robot that starts with its machine."""
RECORD_BYTES = 512
"""One sector of a disk, which is written completely or not at all."""
_BY_CHARACTERS = 60
_FLAGS = os.O_NOFOLLOW | os.O_CLOEXEC


class LatchEntry(NamedTuple):
    """The content of a record."""

    latched: bool
    by: str
    when: str = ""
    """Wall time, for people."""


def state_dir() -> Path:
    """The place of a robot's state that must survive a reboot."""
    if explicit := os.environ.get(STATE_DIR):
        return Path(explicit).absolute()
    with suppress(OSError):
        if MACHINES.stat().st_uid == os.geteuid():
            return MACHINES
    if state := os.environ.get("XDG_STATE_HOME"):
        return Path(state) / "cocoro"
    return Path(os.path.expanduser("~")) / ".local" / "state" / "cocoro"  # noqa: PTH111 # Path.home raises without a home


def latch_dir(robot: str) -> Path:
    return state_dir() / robot / "latch"


def prepare(folder: Path, services: Iterable[str], *, by_hand: bool) -> dict[str, LatchEntry]:
    """Makes missing records, and returns the content of all, by service.

    When there is no record at all, this machine never had a latch: a start by hand makes released records, an automatic
    start makes latched ones. A record that is missing beside others is made latched.
    Raises OSError when the folder cannot be made or written; its `strerror` gives the reason.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.lstat()
    if status.st_uid != os.getuid() or status.st_mode & 0o022:
        raise PermissionError(1, "another user could write to it", str(folder))
    services = sorted(services)
    known = any(folder.iterdir())
    fresh = LatchEntry(False, "the first start") if by_hand and not known else None
    for service in services:
        if not os.path.lexists(folder / service):
            missing = LatchEntry(True, "its record was missing" if known else "a first start without a person")
            _make(folder, service, fresh or missing)
    return {service: read(folder / service) for service in services}


def read(path: Path) -> LatchEntry:
    """Reads a record. One that cannot be read is returned as latched, with the reason as its sender."""
    try:
        fd = os.open(path, os.O_RDONLY | _FLAGS)
    except OSError as error:
        return _unreadable(path, error.strerror or str(error))
    try:
        return _decoded(path, os.pread(fd, RECORD_BYTES + 1, 0))
    except OSError as error:
        return _unreadable(path, error.strerror or str(error))
    finally:
        os.close(fd)


class LatchRecord:
    """One service's record, held open, so that `keep` needs no space on the disk and no path."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entry = read(path)
        """The content, or what it will be when the last write is done."""
        self.last: Future[str] = Future()
        """Result of the last write: why it is not on the disk, or '' when it is."""
        self.last.set_result("" if self.entry.when else self.entry.by)  # an unreadable record is not on the disk
        self._fd: int | None = None
        with suppress(OSError):
            self._fd = os.open(path, os.O_RDWR | _FLAGS)
        self._lock = threading.Lock()
        self._wanted: SimpleQueue[tuple[bytes, Future[str]]] = SimpleQueue()
        threading.Thread(target=self._write_all, name=f"latch {path.name}", daemon=True).start()

    def keep(self, latched: bool, by: str) -> Future[str]:
        """Starts to write a state, unless it is the present one. The future gives why it is not on the disk, or '' when
        it is. From any thread."""
        with self._lock:
            failed = self.last.done() and self.last.result()
            if failed or self.entry.latched != latched:
                self.entry = LatchEntry(latched, by)
                self.last = Future()
                self._wanted.put((_record(self.entry), self.last))
            return self.last

    def _write_all(self) -> None:
        while True:
            data, done = self._wanted.get()
            done.set_result(self._write(data))

    def _write(self, data: bytes) -> str:
        try:
            if self._fd is None or os.fstat(self._fd).st_nlink == 0:  # it was missing, or has been removed
                self._fd = _make_file(self.path, data)  # the descriptor of a removed file stays open; that is rare
            os.pwrite(self._fd, data, 0)
            if os.fstat(self._fd).st_size != RECORD_BYTES:  # it was damaged
                os.ftruncate(self._fd, RECORD_BYTES)
            os.fsync(self._fd)
        except Exception as error:  # the next write is tried all the same
            return f"{self.path}: {getattr(error, 'strerror', None) or error}"
        return ""


def _record(entry: LatchEntry) -> bytes:
    by = "".join(character for character in entry.by if character.isprintable())[:_BY_CHARACTERS]
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    body = json.dumps({"latched": entry.latched, "by": by, "when": when}, ensure_ascii=False).encode(errors="replace")
    return f"{zlib.crc32(body):08x} ".encode() + body.ljust(RECORD_BYTES - 10) + b"\n"


def _decoded(path: Path, data: bytes) -> LatchEntry:
    body = data[9:-1].rstrip()
    if len(data) != RECORD_BYTES or data[-1:] != b"\n" or data[:9] != f"{zlib.crc32(body):08x} ".encode():
        return _unreadable(path, "it is damaged")
    try:
        found = json.loads(body)
        return LatchEntry(bool(found["latched"]), str(found["by"]), str(found["when"]))
    except (ValueError, TypeError, KeyError):
        return _unreadable(path, "it has an unknown format")


def _unreadable(path: Path, why: str) -> LatchEntry:
    return LatchEntry(True, f"the record {path}, which cannot be read: {why}")


def _make(folder: Path, service: str, entry: LatchEntry) -> None:
    os.close(_make_file(folder / service, _record(entry)))


def _make_file(path: Path, data: bytes) -> int:
    """Makes a record, completely or not at all even after a power cut; returns its descriptor, open for writing."""
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
