"""Say stop to everything that moves on this machine, and gather what it answers.

Nothing is imported here that would make it slower: from the start of Python to the first datagram it takes as long as
Python needs to start.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from contextlib import suppress

SOCKETS = "/proc/net/unix"
PREFIX = "@cocoro-stop/"
"""As the kernel lists the addresses of `cocoro.stop.path`."""
LOOK_AGAIN_S = 0.02
"""How often those that had no room for a datagram are told again, and who has come meanwhile is looked for."""
_CREDENTIALS = struct.Struct("3i")


class Point:
    """One address that was told to stop."""

    def __init__(self, address: str) -> None:
        uid, self.robot, self.service, _ = address.removeprefix(PREFIX).split("/")
        self.uid = int(uid)
        self.address = b"\0" + address[1:].encode()
        self.told = False
        self.gone = False
        self.latched_ns: int | None = None
        """When its process stopped what it moves, CLOCK_MONOTONIC."""
        self.kept: bool | None = None
        """Whether the latch is on the disk; None while that is not known, or another process keeps it."""
        self.why_not_kept = ""
        self.settled = False
        """Nothing more is to be heard from it."""


class Asking:
    """Stops one robot by name, or all, from its making on. A context manager.

    Raises OSError where the kernel does not list its sockets (no /proc), or has no socket left for this process.
    """

    def __init__(self, robot: str | None = None, by: str = "operator") -> None:
        self.points: dict[str, Point] = {}
        """By address. It grows as long as new ones appear."""
        self._robot = robot
        self._by = by.encode()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        try:
            self._socket.bind(b"")  # the kernel chooses an address for the answers
            self._tell()
        except OSError:
            self._socket.close()
            raise

    def __enter__(self) -> Asking:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def go_on(self, until_s: float) -> None:
        """Hear answers, and tell again who could not be told, until then (monotonic) or until all have answered."""
        while self.waiting and (left_s := until_s - time.monotonic()) > 0:
            if select.select([self._socket], [], [], min(left_s, LOOK_AGAIN_S))[0]:
                self._hear()
            else:
                self._tell()

    @property
    def waiting(self) -> list[Point]:
        """Those that have not said that they are latched."""
        return [point for point in self.points.values() if point.latched_ns is None and not point.gone]

    def hear_of_the_disk(self, until_s: float) -> None:
        """Hear, until then at the latest, from all that are latched whether the latch is kept."""
        while (left_s := until_s - time.monotonic()) > 0 and any(
            point.latched_ns is not None and not point.settled for point in self.points.values()
        ):
            if select.select([self._socket], [], [], left_s)[0]:
                self._hear()

    def _tell(self) -> None:
        for address in addresses(self._robot):
            if address not in self.points:
                with suppress(ValueError):  # an address of somebody's who does not know what it is for
                    self.points[address] = Point(address)
        for point in self.points.values():
            if not point.told:
                try:
                    self._socket.sendto(self._by, point.address)
                    point.told = True
                except BlockingIOError:  # it has many waiting: told again
                    pass
                except OSError:  # it ended just now
                    point.gone = True

    def _hear(self) -> None:
        with suppress(BlockingIOError):
            while True:
                text, ancillary, _, sender = self._socket.recvmsg(512, socket.CMSG_SPACE(_CREDENTIALS.size))
                self._answered(text, ancillary, sender)

    def _answered(self, text: bytes, ancillary: list[tuple[int, int, bytes]], sender: object) -> None:
        """An answer counts when it comes from the address that was told, and from the user that the address names."""
        if not isinstance(sender, bytes):
            return
        point = self.points.get("@" + sender[1:].decode(errors="replace"))
        if point is None or _uid(ancillary) != point.uid:
            return
        word, _, rest = text.decode(errors="replace").partition(" ")
        about = rest.partition(" ")[2]
        if word == "latched" and about.isdecimal() and point.latched_ns is None:
            point.latched_ns = int(about)
        elif word in ("kept", "unkept"):
            point.kept, point.why_not_kept, point.settled = word == "kept", about, True
        elif word == "keepless":
            point.settled = True


def addresses(robot: str | None = None) -> list[str]:
    """All addresses of the stop path on this machine, or those of robots of one name; own ones first.

    Raises OSError where the kernel does not list its sockets (no /proc).
    """
    found = []
    with open(SOCKETS, "rb") as sockets:  # noqa: PTH123 # pathlib takes as long to import as all else here
        for line in sockets:
            name = line.rstrip(b"\n").partition(PREFIX.encode())[2]
            if name and (robot is None or name.split(b"/")[1:2] == [robot.encode()]):
                with suppress(UnicodeDecodeError):
                    found.append(PREFIX + name.decode())
    own = f"{PREFIX}{os.getuid()}/"
    return sorted(dict.fromkeys(found), key=lambda address: not address.startswith(own))


def _uid(ancillary: list[tuple[int, int, bytes]]) -> int | None:
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS) and len(data) >= _CREDENTIALS.size:
            return int(_CREDENTIALS.unpack_from(data)[1])
    return None
