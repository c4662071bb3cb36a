"""A client of the cockpit that floods: `python -m bench.cockpit_flood KIND PORT SECONDS [USER]`.

It has the lowest priority, so that what is measured beside it is what the cockpit does, and not what the client takes
of this machine. At its end it prints as JSON what it has sent. With USER it becomes that user before.

requests     10,000 requests a second, on connections that are kept as long as they are let
connections  as many new connections as it can make, each closed at once
silent       500 open connections that say nothing
rubbish      connections with random bytes
frames       messages of 100 MB
pings        frames of one byte, and pings
readers      pages that read nothing
"""

from __future__ import annotations

import json
import os
import random
import socket
import struct
import sys
import time
from collections.abc import Callable
from contextlib import suppress

REQUESTS_HZ = 10_000
TICK_S = 0.01
SOCKETS = 500
HUGE = 100_000_000
UPGRADE = (
    "GET /live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


class Flood:
    """Connections of one kind, and what was done with them."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.sent = {"connections": 0, "requests": 0, "bytes": 0}
        self._held: list[socket.socket] = []

    def begin(self, buffer: int = 0) -> socket.socket | None:
        """A new connection; None when the kernel has no room for it now."""
        one = socket.socket()
        one.settimeout(0.05)
        if buffer:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        try:
            one.connect(("127.0.0.1", self.port))
        except OSError:
            one.close()
            return None
        one.setblocking(False)
        self.sent["connections"] += 1
        return one

    def hold(self, count: int, begins: bytes = b"", buffer: int = 0) -> list[socket.socket]:
        """So many connections that are open, each begun with some bytes; at most 50 are new."""
        self._held = [one for one in self._held if _is_open(one)]
        for _ in range(min(50, count - len(self._held))):
            one = self.begin(buffer)
            if one is None:
                break
            self.give(one, begins)
            self._held.append(one)
        return self._held

    def give(self, one: socket.socket, data: bytes) -> bool:
        """Sends what the other side takes; returns whether it took all."""
        try:
            count = one.send(data)
        except BlockingIOError:
            return False
        except OSError:
            self.drop(one)
            return False
        self.sent["bytes"] += count
        return count == len(data)

    def drop(self, one: socket.socket) -> None:
        one.close()
        if one in self._held:
            self._held.remove(one)

    # --- kinds ------------------------------------------------------------------------------------

    def requests(self) -> None:
        asked = f"GET /captures HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\n\r\n".encode()
        each = max(1, int(REQUESTS_HZ * TICK_S) // 20)
        for one in list(self.hold(20)):
            _discard(one)
            if self.give(one, asked * each):
                self.sent["requests"] += each

    def connections(self) -> None:
        until_s = time.monotonic() + TICK_S
        while time.monotonic() < until_s:
            if (one := self.begin()) is not None:
                one.close()

    def silent(self) -> None:
        self.hold(SOCKETS)

    def rubbish(self) -> None:
        for one in list(self.hold(20)):
            self.give(one, random.randbytes(2000))
            _discard(one)

    def frames(self) -> None:
        begins = UPGRADE.format(port=self.port).encode() + bytes([0x82, 0xFF]) + struct.pack("!Q", HUGE) + bytes(4)
        for one in list(self.hold(4, begins)):
            _discard(one)
            while self.give(one, bytes(65536)):
                pass

    def pings(self) -> None:
        tiny = (bytes([0x89, 0x80]) + bytes(4)) * 3000 + (bytes([0x81, 0x81]) + bytes(5)) * 10
        for one in list(self.hold(4, UPGRADE.format(port=self.port).encode())):
            _discard(one)
            self.give(one, tiny)

    def readers(self) -> None:
        self.hold(8, UPGRADE.format(port=self.port).encode(), buffer=4096)


def _is_open(one: socket.socket) -> bool:
    if one.fileno() < 0:
        return False
    try:
        if one.recv(1, socket.MSG_PEEK):
            return True
    except BlockingIOError:
        return True
    except OSError:
        pass
    one.close()
    return False


def _discard(one: socket.socket) -> None:
    with suppress(OSError):
        while one.recv(65536):
            pass


def main(kind: str, port: int, seconds: float, user: int | None = None) -> None:
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    if user is not None:
        os.setgid(user)
        os.setuid(user)
    flood = Flood(port)
    turn: Callable[[], None] = getattr(flood, kind)
    begun_s = time.monotonic()
    print("floods", flush=True)
    next_s = begun_s
    while time.monotonic() < begun_s + seconds:
        turn()
        next_s = max(next_s + TICK_S, time.monotonic() - TICK_S)
        time.sleep(max(0.0, next_s - time.monotonic()))
    took_s = time.monotonic() - begun_s
    print(json.dumps({name: count / took_s for name, count in flood.sent.items()}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]) if len(sys.argv) > 4 else None)
