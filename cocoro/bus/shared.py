"""The machine's shared memory as zenoh uses it: how much it needs, whether that is available, and its removal.

Zenoh's segments are the files NUMBER.zenoh in /dev/shm. Each process that maps a segment holds a lock (flock) on it and
locks its pages in memory (mlock). So a segment takes all of its room when it is made, and a publisher keeps working
when /dev/shm fills later. A process that ends without closing its segments leaves the files; a file that no process
holds may be removed.

Shared memory is optional: without it, frames are copied through the mesh's sockets. That is decided once, when the
process starts.
"""

from __future__ import annotations

import fcntl
import os
import re
import resource
import stat
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

PLACE = Path("/dev/shm")
POOL_BYTES = 24 * 1024 * 1024
"""One publisher's pool: fifteen frames of 640 x 480. A receiver holds one or two; a stopped one all."""
PROCESS_BYTES = 1_310_720
"""Zenoh's register of shared buffers, per process that publishes frames."""
SESSION_BYTES = 12_288
"""Zenoh's segment by which a process that publishes or reads frames proves that it runs on this machine."""
LOCKED_BYTES = POOL_BYTES + PROCESS_BYTES + 64 * SESSION_BYTES
"""Memory that one process locks: a publisher's segments (readers lock them, too), and those of 64 other processes."""
COSTS = "frames are copied through sockets instead, which costs more"
NEWBORN_S = 10.0
"""An empty segment that is younger than this is just being made."""
_SEGMENT = re.compile(r"\d+\.zenoh")
_IPC_LOCK = 1 << 14
"""CAP_IPC_LOCK: the process may lock any amount of memory."""


def need_bytes(publishers: int, readers: int) -> int:
    """The room in /dev/shm for processes that publish frames and processes that read them, bytes."""
    return publishers * (POOL_BYTES + PROCESS_BYTES) + (publishers + readers) * SESSION_BYTES


def obstacle(wanted_bytes: int) -> str:
    """The reason for which this process cannot have `wanted_bytes` of shared memory, with advice; '' when it can."""
    if wanted_bytes == 0:
        return ""
    try:
        room = os.statvfs(PLACE)
    except OSError as error:
        return f"{PLACE}: {error.strerror}"
    if not os.access(PLACE, os.W_OK | os.X_OK):
        return f"{PLACE} cannot be written"
    free_bytes = room.f_bavail * room.f_frsize
    if free_bytes < wanted_bytes:
        return (
            f"{PLACE} has {_mb(free_bytes)} free, {_mb(wanted_bytes)} are needed "
            f"({_mb(wanted_bytes - free_bytes)} more): make room, or mount it larger"
        )
    may_lock = lockable_bytes()
    if may_lock is not None and may_lock < LOCKED_BYTES:
        return (
            f"a process of this user's may lock {_mb(may_lock)} in memory, {_mb(LOCKED_BYTES)} are needed: raise "
            f"memlock in /etc/security/limits.conf (LimitMEMLOCK of a unit)"
        )
    return ""


def lockable_bytes() -> int | None:
    """Memory that this process may lock, bytes; None: any amount. Raises its soft limit to its hard limit."""
    with suppress(OSError, ValueError):
        capabilities = re.search(r"^CapEff:\s*([0-9a-f]+)", Path("/proc/self/status").read_text(), re.MULTILINE)
        if capabilities is not None and int(capabilities[1], 16) & _IPC_LOCK:
            return None
    soft, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != hard:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_MEMLOCK, (hard, hard))
            soft = hard
    return None if soft == resource.RLIM_INFINITY else soft


def sweep() -> int:
    """Removes this user's segments that no process holds. Returns their number."""
    removed = 0
    with suppress(OSError):
        for entry in list(os.scandir(PLACE)):
            if _SEGMENT.fullmatch(entry.name):
                with suppress(OSError):
                    removed += _remove_if_dead(entry.path)
    return removed


def drop_failed() -> int:
    """Removes segments that zenoh could not finish in this process, which stay mapped and take room until its end.
    Returns their number."""
    removed = 0
    with suppress(OSError):
        mapped = {line.split(maxsplit=5)[-1] for line in Path("/proc/self/maps").read_text().splitlines()}
        held = {str(Path(f"/proc/self/fd/{fd}").readlink()) for fd in _held()}
        for path in (Path(name) for name in mapped - held):
            if path.parent == PLACE and _SEGMENT.fullmatch(path.name):
                with suppress(OSError):
                    os.truncate(path, 0)
                    path.unlink()
                    removed += 1
    return removed


def release() -> int:
    """Removes segments that only this process holds, after its sessions are closed; returns their number."""
    removed = 0
    for fd in _held():
        with suppress(OSError):
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            removed += _unlink(str(Path(f"/proc/self/fd/{fd}").readlink()), os.fstat(fd))
    return removed


def segments() -> dict[str, int]:
    """The sizes of this user's segments, bytes, by name."""
    found = {}
    with suppress(OSError):
        for entry in os.scandir(PLACE):
            with suppress(OSError):
                status = entry.stat(follow_symlinks=False)
                if _SEGMENT.fullmatch(entry.name) and status.st_uid == os.geteuid():
                    found[entry.name] = status.st_size
    return found


def _remove_if_dead(path: str) -> bool:
    fd = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        status = os.fstat(fd)
        ours = stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid()
        if not ours or (status.st_size == 0 and time.time() - status.st_mtime < NEWBORN_S):
            return False
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return _unlink(path, status)
    finally:
        os.close(fd)


def _unlink(path: str, status: os.stat_result) -> bool:
    """Removes a file unless another one has its name now; returns whether it did."""
    if not os.path.samestat(os.stat(path, follow_symlinks=False), status):  # noqa: PTH116 # the path is a string
        return False
    os.unlink(path)  # noqa: PTH108
    return True


def _held() -> Iterable[int]:
    """The descriptors of the segments that this process holds."""
    try:
        entries = list(os.scandir("/proc/self/fd"))
    except OSError:  # no /proc
        return
    for entry in entries:
        with suppress(OSError):
            target = Path(entry.path).readlink()
            if target.parent == PLACE and _SEGMENT.fullmatch(target.name):
                yield int(entry.name)


def _mb(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.0f} kB"
