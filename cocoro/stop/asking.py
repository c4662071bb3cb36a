"""Say stop to everything that moves on this machine, and gather what it answers.

Nothing is imported here that would make it slower: from the start of Python to the first datagram it takes as long as
Python needs to start.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import time
from contextlib import suppress

from cocoro.stop.owners import owners

SOCKETS = "/proc/net/unix"
PREFIX = "@cocoro-stop/"
"""As the kernel lists the addresses of `cocoro.stop.path`."""
LOOK_AGAIN_S = 0.02
"""How often those that had no room for a datagram are told again, and who has come meanwhile is looked for."""
TELL_AGAIN_S = 0.2
"""How often those that say nothing are told again: an answer may be lost where it has no line of its own."""
TEXT_BYTES = 512
AT_ONCE = 8
ENDED = (errno.ECONNREFUSED, errno.EPIPE, errno.EPROTOTYPE)
"""Nobody is at the address any more, or somebody who hears no datagrams."""
_CREDENTIALS = struct.Struct("3i")


class Point:
    """One address that was told to stop. Raises ValueError for an address that is none of the stop path's."""

    def __init__(self, address: str, owner: int | None) -> None:
        """`owner` is the user whose socket it is; None where the kernel does not tell, which takes the name's word."""
        uid, self.robot, self.service, _ = address.removeprefix(PREFIX).split("/")
        self.uid = int(uid)
        if owner is not None:
            self.uid = owner
        if not (self.robot + self.service).isprintable():
            raise ValueError(address)
        self.address = _raw(address)
        self.line: socket.socket | None = None
        """Connected to it alone."""
        self.told_s: float | None = None
        """When it was told last, monotonic."""
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
        self._by = by.encode(errors="replace")
        found = addresses(robot)  # first, since a file and a socket at once may be more than this process may open
        self._shared = _socket()
        """For those that get no line of their own: this process may not open that many."""
        self._poll = select.poll()
        self._poll.register(self._shared, select.POLLIN)
        self._lines = {self._shared.fileno(): self._shared}
        self._on_line: dict[int, Point] = {}
        """By the number of its line."""
        self._tell(found)

    def __enter__(self) -> Asking:
        return self

    def __exit__(self, *_: object) -> None:
        for line in self._lines.values():
            line.close()

    def go_on(self, until_s: float) -> None:
        """Hear answers, and tell again who could not be told or says nothing, until then (monotonic) or until all have
        answered."""
        look_s = time.monotonic() + LOOK_AGAIN_S
        while (now_s := time.monotonic()) < until_s:
            all_answered = not self.waiting
            if all_answered or now_s >= look_s:
                with suppress(OSError):  # this process may open no file now: those that were told are heard
                    self._tell(addresses(self._robot))
                if all_answered and not self.waiting:
                    return
                look_s = time.monotonic() + LOOK_AGAIN_S
            self._hear(min(until_s, look_s) - time.monotonic())

    @property
    def waiting(self) -> list[Point]:
        """Those that have not said that they are latched."""
        return [point for point in self.points.values() if point.latched_ns is None and not point.gone]

    def hear_of_the_disk(self, until_s: float) -> None:
        """Hear, until then at the latest, from all that are latched whether the latch is kept."""
        while (left_s := until_s - time.monotonic()) > 0 and any(
            point.latched_ns is not None and not point.settled for point in self.points.values()
        ):
            self._hear(left_s)

    def _tell(self, found: dict[str, int | None]) -> None:
        for address, owner in found.items():
            if address not in self.points:
                with suppress(ValueError):  # an address of somebody's who does not know what it is for
                    self.points[address] = Point(address, owner)
        for point in self.waiting:
            if point.told_s is None or time.monotonic() - point.told_s > TELL_AGAIN_S:
                self._tell_one(point)

    def _tell_one(self, point: Point) -> None:
        try:
            self._line_to(point).sendto(self._by, point.address)
            point.told_s = time.monotonic()
        except OSError as error:  # else it has many waiting, or there is no memory just now: told again
            point.gone = error.errno in ENDED
        if point.line is not None:  # in a flood there is room for a moment only
            awaits_room = point.told_s is None and not point.gone
            self._poll.modify(point.line, select.POLLIN | (select.POLLOUT if awaits_room else 0))

    def _line_to(self, point: Point) -> socket.socket:
        """A line on which it alone can answer, so that nobody else fills the queue of its answers."""
        if point.line is None:
            try:
                point.line = _socket()
            except OSError:
                return self._shared
            self._lines[point.line.fileno()] = point.line
            self._on_line[point.line.fileno()] = point
            self._poll.register(point.line, select.POLLIN)
            point.line.connect(point.address)
        return point.line

    def _hear(self, wait_s: float) -> None:
        """Wait so long at most for answers, and take some of each line: one who never ceases keeps nobody else from
        being heard."""
        for fd, events in self._poll.poll(max(wait_s * 1000.0, 0.0)):
            if events & select.POLLOUT:
                self._tell_one(self._on_line[fd])
            with suppress(OSError):
                for _ in range(AT_ONCE):
                    ancillary_bytes = socket.CMSG_SPACE(_CREDENTIALS.size)
                    text, ancillary, _, sender = self._lines[fd].recvmsg(TEXT_BYTES, ancillary_bytes)
                    self._answered(text, ancillary, sender)

    def _answered(self, text: bytes, ancillary: list[tuple[int, int, bytes]], sender: object) -> None:
        """An answer counts when it comes from the address that was told, and from the user whose address it is."""
        if not isinstance(sender, bytes):
            return
        point = self.points.get("@" + sender[1:].decode(errors="replace"))
        if point is None or _uid(ancillary) != point.uid:
            return
        said = "".join(character for character in text.decode(errors="replace") if character.isprintable())
        word, _, rest = said.partition(" ")
        about = rest.partition(" ")[2]
        if word == "latched" and about.isascii() and about.isdecimal() and point.latched_ns is None:
            point.latched_ns = int(about)
        elif word in ("kept", "unkept"):
            point.kept, point.why_not_kept, point.settled = word == "kept", about, True
        elif word == "keepless":
            point.settled = True


def addresses(robot: str | None = None) -> dict[str, int | None]:
    """All addresses of the stop path on this machine, or those of robots of one name, and the user whose each is (None
    where the kernel does not tell); own ones first.

    Raises OSError where the kernel does not list its sockets (no /proc).
    """
    found = []
    with open(SOCKETS, "rb") as sockets:  # noqa: PTH123 # pathlib takes as long to import as all else here
        for line in sockets:
            name = line.rstrip(b"\n").partition(PREFIX.encode())[2]
            if name and (robot is None or name.split(b"/")[1:2] == [os.fsencode(robot)]):
                with suppress(UnicodeDecodeError):
                    found.append(PREFIX + name.decode())
    users = owners(_raw(PREFIX)) if found else {}
    whose = {address: users.get(_raw(address)) for address in found}
    return dict(sorted(whose.items(), key=lambda one: one[1] != os.getuid()))


def _socket() -> socket.socket:
    """For datagrams, with an address that the kernel chose."""
    one = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        one.bind(b"")
    except OSError:
        one.close()
        raise
    return one


def _raw(address: str) -> bytes:
    """As the kernel takes it: it lists the leading zero as @."""
    return b"\0" + address[1:].encode()


def _uid(ancillary: list[tuple[int, int, bytes]]) -> int | None:
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS) and len(data) >= _CREDENTIALS.size:
            return int(_CREDENTIALS.unpack_from(data)[1])
    return None
