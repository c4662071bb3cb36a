"""The receiving side of the emergency stop: a datagram socket in Linux's abstract namespace per service.

The address is `\\0cocoro-stop/UID/ROBOT/SERVICE/RANDOM`. The kernel lists all addresses in /proc/net/unix, for every
user, so no register is needed; the random part keeps other programs from taking an address first. There are no
connections that could be used up. **Every datagram is a stop**, whatever its text: flooding the address stops the
robot. The text is only the name that the sender gives itself; its user and process come from the kernel
(SCM_CREDENTIALS, unix(7)).
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
"""Senders that get a second answer when the latch is on the disk; more at a time are a flood."""
FAILURE_S = 0.1
"""Pause after a failure of the path; each failure halts."""
_CREDENTIALS = struct.Struct("3i")


class Asked(NamedTuple):
    """One received stop."""

    by: str
    """The sender, for people: 'operator (user 1000, pid 4711)'."""
    answer_to: bytes
    """The sender's address; empty when it wants no answer."""


class StopPoint:
    """The address of one service, in the process that moves it.

    Raises OSError when no such socket can be made: what cannot be stopped must not move.
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
        """The next stop; None when there is none. With `wait` it blocks, and returns None only after `close`."""
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
        """Answers that this process stopped what it moves at `at_ns` (CLOCK_MONOTONIC)."""
        self._answer(asked, f"latched {self.service} {at_ns}")

    def kept(self, asked: Asked, why_not: str = "") -> None:
        """Answers that the latch is on the disk, or why it is not."""
        self._answer(asked, f"unkept {self.service} {why_not}" if why_not else f"kept {self.service}")

    def keeps_nothing(self, asked: Asked) -> None:
        """Answers that another process keeps the latch of what this one moves."""
        self._answer(asked, f"keepless {self.service}")

    def _answer(self, asked: Asked, text: str) -> None:
        if asked.answer_to:
            with suppress(OSError):  # the sender has gone or does not read, which must delay nothing
                self._socket.sendto(text.encode()[:TEXT_BYTES], socket.MSG_DONTWAIT, asked.answer_to)

    def close(self) -> None:
        """Stops listening; a waiting `take` returns."""
        self.closed = True
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


def _who(text: bytes, ancillary: list[tuple[int, int, bytes]]) -> str:
    name = "".join(c for c in text.decode(errors="replace")[:40] if c.isprintable()).strip() or "unknown sender"
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS) and len(data) >= _CREDENTIALS.size:
            pid, uid, _ = _CREDENTIALS.unpack_from(data)
            return f"{name} (user {uid}, pid {pid})"
    return name


def listen(point: StopPoint, halt: Callable[[str], None], keep: Callable[[str], Future[str]]) -> None:
    """Receives stops in a thread until the point is closed, independently of the event loop and the disk.

    `halt(by)` stops what the service moves; it is called in that thread and must be brief. `keep(by)` starts to write
    the latch to the disk; its future gives why it is not on the disk, or ''. Any failure here also halts, without an
    answer, and the thread goes on: what cannot be stopped must not move.
    """
    room = threading.BoundedSemaphore(WAITING_FOR_THE_DISK)

    def receive() -> None:
        while not point.closed:
            try:
                if (asked := point.take(wait=True)) is not None:
                    halt(asked.by)
                    point.latched(asked, time.monotonic_ns())
                    _answer_when_kept(point, asked, keep(asked.by), room)
            except Exception:
                with suppress(Exception):
                    halt("the failure of its own path")
                _log_failure(point.service)
                time.sleep(FAILURE_S)

    threading.Thread(target=receive, name=f"stop {point.service}", daemon=True).start()


def _answer_when_kept(point: StopPoint, asked: Asked, kept: Future[str], room: threading.BoundedSemaphore) -> None:
    """Answers again when the write is done, at once; while the disk hangs, for `WAITING_FOR_THE_DISK` senders."""

    def answer(kept: Future[str]) -> None:
        room.release()
        point.kept(asked, kept.result())

    if room.acquire(blocking=False):
        kept.add_done_callback(answer)


def _log_failure(service: str) -> None:
    import logging  # imported here, since the guard of the wheels must start quickly

    with suppress(Exception):
        logging.getLogger(f"cocoro.{service}").exception("the emergency stop's path failed, so it halted")
