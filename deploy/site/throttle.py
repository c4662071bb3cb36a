"""Holds back a person's link that carries more than persons have to say, so that the gateway has time for the robot.

zenoh reads and decrypts what comes on a link before its rules refuse it: whoever is admitted may so take a whole core
of the gateway, and of the network, by messages as large as he likes. So a person has an allowance for all his links,
which fills with `ALLOWED_BYTES_S`. When it is used up, the socket of the link gets a small receive buffer, which lets
in so much in a round trip, and the kernel takes the content from its packets for a moment, by a filter (socket(7),
SO_ATTACH_FILTER): TCP sends it again, later, as on a link that loses packets. The link stays: no moment is as long as
zenoh waits for a sign of life. What goes the other way is not disturbed, and what is not too large for a slow link
(zenoh gives up a message that it cannot send in 5 s, and links anew) arrives. Links of other hosts are never held back:
frames go there.

zenoh gives nobody its sockets: they are found among this process's own by the address at their other end.
"""

from __future__ import annotations

import ctypes
import os
import socket
import struct
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path

from cocoro.bus.router import Link

PERIOD_S = 0.02
"""Between two looks at the links."""
ALLOWED_BYTES_S = 3e6
"""More than a person's program has to say at any time: a hundred times his questions, commands and own topics."""
SAVED_S, AGAIN_S, DEBT_S = 1.0, 0.25, 0.25
"""Allowance that a silent person saves; with which held links go on; and that is counted against him at the most, which
keeps the moments short."""
SLOW_BYTES = 4096
"""Receive buffer of a link that has used up its allowance; the kernel doubles it."""
CALM_S = 10.0
"""So long after that it gets back the buffer that it had."""
HEADERS_ONLY = struct.pack("HBBI", 0x06, 0, 0, 1)
"""The filter, one instruction of classic BPF: keep one byte, and with it all headers."""
ATTACH, DETACH = 26, 27
"""SO_ATTACH_FILTER and SO_DETACH_FILTER, see asm/socket.h."""
_RECEIVED = struct.Struct("128xQ")
"""The bytes received in `struct tcp_info` of Linux, see linux/tcp.h."""


@dataclass
class Watched:
    """A person's link."""

    socket: socket.socket
    """A duplicate of zenoh's: options that are set here hold there."""
    received: int
    buffer_bytes: int
    """The receive buffer that it had, as the kernel counts it."""
    held: bool = False
    slow_until_s: float | None = None


class Throttle:
    """The links of persons, by zenoh's id. `look` is to be called about every `PERIOD_S`."""

    def __init__(self, tell: Callable[[Link], None]) -> None:
        """`tell` is called when links of a person are held back for the first time."""
        self._tell = tell
        self._watched: dict[Link, Watched] = {}
        self._allowances: dict[str, float] = {}
        """Bytes that the links of each person may carry at once; negative when they carried more."""
        self._told: set[str] = set()
        self._looked_s = inf

    def follow(self, links: Iterable[Link]) -> None:
        """These are the persons' links now."""
        wanted = set(links)
        for link in set(self._watched) - wanted:
            self._watched.pop(link).socket.close()
        if missing := wanted - set(self._watched):
            mine = sockets()
            for link in missing:
                if (found := mine.pop(_end(link.address), None)) is not None:
                    self._watched[link] = Watched(found, received(found), buffer_of(found))
            for left in mine.values():
                left.close()

    def look(self, now_s: float) -> None:
        """Holds back the links that have used up their allowance, and lets them go when there is some again."""
        more = ALLOWED_BYTES_S * max(now_s - self._looked_s, 0.0)
        self._looked_s = now_s
        for who, allowance in self._allowances.items():
            self._allowances[who] = min(allowance + more, ALLOWED_BYTES_S * SAVED_S)
        for link, watched in self._watched.items():
            before, watched.received = watched.received, received(watched.socket)
            left = self._allowances.get(link.who, ALLOWED_BYTES_S * SAVED_S) - max(watched.received - before, 0)
            self._allowances[link.who] = left = max(left, -ALLOWED_BYTES_S * DEBT_S)
            if left < 0.0 and not watched.held:
                self._hold(link, watched, now_s)
            elif watched.held and left > ALLOWED_BYTES_S * AGAIN_S:
                watched.held = False
                let_go(watched.socket)
            elif watched.slow_until_s is not None and now_s > watched.slow_until_s:
                watched.slow_until_s = None
                set_buffer(watched.socket, watched.buffer_bytes // 2)

    def _hold(self, link: Link, watched: Watched, now_s: float) -> None:
        watched.held = True
        if watched.slow_until_s is None:
            set_buffer(watched.socket, SLOW_BYTES)
        watched.slow_until_s = now_s + CALM_S
        hold(watched.socket)
        if link.who not in self._told:
            self._told.add(link.who)
            self._tell(link)

    def close(self) -> None:
        for watched in self._watched.values():
            watched.socket.close()
        self._watched.clear()


def sockets() -> dict[tuple[str, int], socket.socket]:
    """Duplicates of this process's connected TCP sockets, by the address and port at their other end."""
    found: dict[tuple[str, int], socket.socket] = {}
    for entry in list(Path("/proc/self/fd").iterdir()):  # without the duplicates
        with suppress(OSError), ExitStack() as stack:
            if not str(entry.readlink()).startswith("socket:"):
                continue
            one = stack.enter_context(socket.socket(fileno=os.dup(int(entry.name))))
            tcp = one.type == socket.SOCK_STREAM and one.family in (socket.AF_INET, socket.AF_INET6)
            if tcp and (peer := one.getpeername()[:2]) not in found:
                found[peer] = one
                stack.pop_all()
    return found


def received(one: socket.socket) -> int:
    """Bytes that have come on a TCP socket so far."""
    try:
        (count,) = _RECEIVED.unpack(one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _RECEIVED.size))
    except (OSError, struct.error):  # it has ended, or an old kernel does not count
        return 0
    return int(count)


def buffer_of(one: socket.socket) -> int:
    """The size of a socket's receive buffer, as the kernel counts it: twice what was set."""
    with suppress(OSError):
        return one.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    return 0


def set_buffer(one: socket.socket, size: int) -> None:
    with suppress(OSError):
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)


def hold(one: socket.socket) -> None:
    """Nothing that is sent to a socket arrives, and all of it is sent again, until `let_go`."""
    program = ctypes.create_string_buffer(HEADERS_ONLY)
    with suppress(OSError):  # it has just ended
        one.setsockopt(socket.SOL_SOCKET, ATTACH, struct.pack("HL", 1, ctypes.addressof(program)))


def let_go(one: socket.socket) -> None:
    with suppress(OSError):
        one.setsockopt(socket.SOL_SOCKET, DETACH, 0)


def _end(address: str) -> tuple[str, int]:
    """Address and port at a link's other end, of zenoh's `tls/ADDRESS:PORT`."""
    host, _, port = address.partition("/")[2].rpartition(":")
    return host.strip("[]"), int(port) if port.isdigit() else 0
