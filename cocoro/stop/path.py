"""Where a process that moves something hears the emergency stop: a datagram socket in Linux's abstract namespace.

The address is `\\0cocoro-stop/UID/ROBOT/SERVICE/RANDOM`. The kernel lists all of them in /proc/net/unix, for every
user, so nobody has to be told where to look; the random end keeps others from taking an address first. There are no
connections, so nobody can use them up. **Every datagram that arrives is a stop**, whatever it says: who floods the
address has stopped the robot. A datagram's text is only the name by which the sender calls himself; who he is says
the kernel (SCM_CREDENTIALS, unix(7)).
"""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import NamedTuple

PREFIX = "cocoro-stop/"
LONGEST_ADDRESS = 107
"""Bytes after the leading zero (unix(7))."""
TEXT_BYTES = 256
WAITING_FOR_THE_DISK = 32
"""So many who asked are told when the latch is on the disk; more of them are a flood."""
FAILURE_S = 0.1
"""A path that goes on failing halts so often."""
_CREDENTIALS = struct.Struct("3i")


class Asked(NamedTuple):
    """One stop that came in."""

    by: str
    """Who said it, for people: 'operator (user 1000, pid 4711)'."""
    answer_to: bytes
    """The asker's address; empty when he wants no answer."""


class StopPoint:
    """One service's address, to be read by the process that moves it.

    Raises OSError when there is no such socket to be had: what cannot be stopped must not move.
    """

    def __init__(self, robot: str, service: str) -> None:
        self.service = service
        name = f"{PREFIX}{os.getuid()}/{robot}/{service}/{os.urandom(4).hex()}".encode()
        if len(name) > LONGEST_ADDRESS:
            raise OSError(f"emergency stop of {robot}/{service}: the names are too long for a socket's address")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._socket.bind(b"\0" + name)
        self.closed = False

    def fileno(self) -> int:
        return self._socket.fileno()

    def take(self, *, wait: bool) -> Asked | None:
        """The next stop; None when there is none (with `wait` only after `close`)."""
        try:
            text, ancillary, _, sender = self._socket.recvmsg(
                TEXT_BYTES, socket.CMSG_SPACE(_CREDENTIALS.size), 0 if wait else socket.MSG_DONTWAIT
            )
        except BlockingIOError:
            return None
        except OSError:
            if self.closed:
                return None
            raise
        if self.closed:
            return None
        return Asked(_who(text, ancillary), sender if isinstance(sender, bytes) else b"")

    def latched(self, asked: Asked, at_ns: int) -> None:
        """Answer that what this process moves was stopped, then (CLOCK_MONOTONIC)."""
        self._answer(asked, f"latched {self.service} {at_ns}")

    def kept(self, asked: Asked, why_not: str = "") -> None:
        """Answer that the latch is on the disk, or why it is not."""
        self._answer(asked, f"unkept {self.service} {why_not}" if why_not else f"kept {self.service}")

    def keeps_nothing(self, asked: Asked) -> None:
        """Answer that another process keeps the latch of what this one moves."""
        self._answer(asked, f"keepless {self.service}")

    def _answer(self, asked: Asked, text: str) -> None:
        if asked.answer_to:
            with suppress(OSError):  # the asker has gone, or does not read: that must hold nothing up
                self._socket.sendto(text.encode()[:TEXT_BYTES], socket.MSG_DONTWAIT, asked.answer_to)

    def close(self) -> None:
        """From now on nobody listens; a `take` that waits returns."""
        self.closed = True
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


def _who(text: bytes, ancillary: list[tuple[int, int, bytes]]) -> str:
    said = "".join(c for c in text.decode(errors="replace")[:40] if c.isprintable()).strip() or "somebody"
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS) and len(data) >= _CREDENTIALS.size:
            pid, uid, _ = _CREDENTIALS.unpack_from(data)
            return f"{said} (user {uid}, pid {pid})"
    return said


def listen(point: StopPoint, halt: Callable[[str], None], keep: Callable[[str], Future[str]]) -> None:
    """Hear stops in a thread of their own until the point is closed, whatever the event loop and the disk do.

    `halt(by)` stops what the service moves; it is called in that thread and must be brief. `keep(by)` begins to write
    the latch to the disk; the future tells why it could not be kept, or ''. Whatever fails here is a stop of its own
    that nobody is told was heard, and the thread goes on: what cannot be stopped must not move.
    """
    room = threading.BoundedSemaphore(WAITING_FOR_THE_DISK)

    def hear() -> None:
        while not point.closed:
            try:
                if (asked := point.take(wait=True)) is not None:
                    halt(asked.by)
                    point.latched(asked, time.monotonic_ns())
                    _tell_when_kept(point, asked, keep(asked.by), room)
            except Exception:
                with suppress(Exception):
                    halt("the failure of its own path")
                _log_failure(point.service)
                time.sleep(FAILURE_S)

    threading.Thread(target=hear, name=f"stop {point.service}", daemon=True).start()


def _tell_when_kept(point: StopPoint, asked: Asked, kept: Future[str], room: threading.BoundedSemaphore) -> None:
    """Answer once more when the disk is done, without waiting for it; where it hangs, not for all who ask meanwhile."""

    def tell(kept: Future[str]) -> None:
        room.release()
        point.kept(asked, kept.result())

    if room.acquire(blocking=False):
        kept.add_done_callback(tell)


def _log_failure(service: str) -> None:
    import logging  # the guard, which has no use for it, is to start quickly

    with suppress(Exception):
        logging.getLogger(f"cocoro.{service}").exception("the emergency stop's own path failed; it halted")
