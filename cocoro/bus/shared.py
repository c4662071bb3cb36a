"""The machine's shared memory as zenoh uses it: what it takes, whether that can be had, and that none of it is left.

Zenoh's segments are the files NUMBER.zenoh in /dev/shm. Every process that maps one holds a lock (flock) on it for as
long as it does, and locks its pages in memory (mlock), so that a segment takes all of its room when it is made, and a
publisher that has its segments does not mind when the place fills later. A process that ends without having closed its
segments leaves the files; one that nobody holds any more belongs to nobody, and may be removed.

Nobody depends on it: what cannot be shared is copied through the mesh's sockets. What a process cannot have at its
start it goes without until it is started again.
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
"""Each publisher's frames. Fifteen colour and depth frames of 640 x 480. Receivers hold one or two each; one that has
stopped holds all."""
PROCESS_BYTES = 1_310_720
"""Zenoh's register of what is shared, in each process that publishes frames."""
SESSION_BYTES = 12_288
"""What each process that publishes or reads frames proves with that it is on this machine."""
LOCKED_BYTES = POOL_BYTES + PROCESS_BYTES + 64 * SESSION_BYTES
"""What one process locks in memory: a publisher's segments, which readers lock, too, and those of whom it meets."""
COSTS = "frames are copied through sockets instead, which costs more"
NEWBORN_S = 10.0
"""A segment without a size is about to get one, unless it is as old as this."""
_SEGMENT = re.compile(r"\d+\.zenoh")
_IPC_LOCK = 1 << 14
"""CAP_IPC_LOCK: locks in memory whatever the limit."""


def need_bytes(publishers: int, readers: int) -> int:
    """The room in /dev/shm that so many processes take that publish frames and that read them."""
    return publishers * (POOL_BYTES + PROCESS_BYTES) + (publishers + readers) * SESSION_BYTES


def obstacle(wanted_bytes: int) -> str:
    """Why this process cannot have so much more of it, by how much, and what to do; empty when it can."""
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
    """What this process may lock in memory; None for any amount. Raises its own limit as far as it may."""
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
    """Remove what dead processes of this user's have left; how many segments that were. Those that anybody holds are
    not touched, whoever's they are."""
    removed = 0
    with suppress(OSError):
        for entry in list(os.scandir(PLACE)):
            if _SEGMENT.fullmatch(entry.name):
                with suppress(OSError):
                    removed += _remove_if_dead(entry.path)
    return removed


def drop_failed() -> int:
    """Remove what zenoh began to make in this process and could not: it stays mapped, and takes its room until the end
    of the process. How many segments that were."""
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
    """Remove the segments that this process holds and nobody else does: for the end of the process, when its sessions
    have been closed. How many they were."""
    removed = 0
    for fd in _held():
        with suppress(OSError):
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            removed += _unlink(str(Path(f"/proc/self/fd/{fd}").readlink()), os.fstat(fd))
    return removed


def segments() -> dict[str, int]:
    """The size in bytes of each of this user's segments, by name, whoever of them holds it or not."""
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
    """Whether it was there, and that very file."""
    if not os.path.samestat(os.stat(path, follow_symlinks=False), status):  # noqa: PTH116 # a string is at hand
        return False
    os.unlink(path)  # noqa: PTH108
    return True


def _held() -> Iterable[int]:
    """The descriptors by which this process holds segments."""
    try:
        entries = list(os.scandir("/proc/self/fd"))
    except OSError:  # no /proc: then nobody can tell
        return
    for entry in entries:
        with suppress(OSError):
            target = Path(entry.path).readlink()
            if target.parent == PLACE and _SEGMENT.fullmatch(target.name):
                yield int(entry.name)


def _mb(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.0f} kB"
