"""The sending side: sends the emergency stop to everything that moves on this machine, and collects the answers.

The receiving side is `cocoro.stop.path`. Only light modules of the standard library are imported, so that the time from
the start of the command to its first datagram is that of starting Python.
"""

from __future__ import annotations

import _socket as socket  # the module of that name makes enumerations and takes 2 ms to import
import errno
import os
import select
import struct
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress

STOPPABLE = ("base", "arm", "hand")
"""The services that move something: a copy of `deploy.processes.stoppable()`, which is slow to import. A test compares
them."""
SOCKETS = "/proc/net/unix"
PREFIX = "@cocoro-stop/"
"""The addresses of `cocoro.stop.path`, as the kernel lists them."""
LOOK_AGAIN_S = 0.02
"""Period of sending again to addresses that had no room for a datagram, and of looking for new addresses."""
TELL_AGAIN_S = 0.2
"""Period of sending again to addresses that do not answer: answers to the shared socket may be lost."""
TEXT_BYTES = 512
AT_ONCE = 8
"""Answers that are read from one socket before the others get their turn."""
ENDED = (errno.ECONNREFUSED, errno.EPIPE, errno.EPROTOTYPE)
"""The errors of sending to an address at which no process receives datagrams any more."""
_CREDENTIALS = struct.Struct("3i")

# sock_diag(7), to ask the kernel for the owners of sockets
_SOCK_DIAG = 4
_BY_FAMILY, _DUMP_REQUEST = 20, 0x301
_SHOW_NAME_AND_USER = 0x01 | 0x40
_NAME, _USER = 0, 7
_HEADER, _ATTRIBUTE = struct.Struct("=IHHII"), struct.Struct("=HH")
_REQUEST = struct.Struct("=BBHIIIII")
_ABOUT_BYTES = 16
"""Bytes between an entry's header and its attributes."""
_PATIENCE_S = 0.1
_MOST_BYTES = 1 << 18


def movers_first(service: str) -> tuple[int, str]:
    """Sort key: services that move something first."""
    return STOPPABLE.index(service) if service in STOPPABLE else len(STOPPABLE), service


class Point:
    """One address of the stop path. Raises ValueError for an address of another form."""

    def __init__(self, address: str, owner: int | None) -> None:
        """`owner`: the user whose socket it is; None where the kernel does not say, then the address's own claim
        counts."""
        uid, self.robot, self.service, _ = address.removeprefix(PREFIX).split("/")
        self.uid = int(uid)
        if owner is not None:
            self.uid = owner
        if not (self.robot + self.service).isprintable():
            raise ValueError(address)
        self.address = _raw(address)
        self.line: socket.socket | None = None
        """A socket that is connected to this address alone."""
        self.sent_s: float | None = None
        """Time of the last datagram, monotonic."""
        self.gone = False
        self.latched_ns: int | None = None
        """Time at which its process stopped what it moves, CLOCK_MONOTONIC; None before its answer."""
        self.kept: bool | None = None
        """Whether the latch is on the disk; None while unknown, and when another process keeps it."""
        self.why_not_kept = ""
        self.settled = False
        """It has sent its last answer."""


class Asking:
    """Stops one robot by name, or all robots. The constructor sends the first datagrams. A context manager.

    Raises OSError where the kernel does not list its sockets (no /proc), or this process may open no socket.
    """

    def __init__(
        self, robot: str | None = None, by: str = "operator", heard: Callable[[Point], None] | None = None
    ) -> None:
        """`heard` is called with each address when it has reported to be latched."""
        self._heard = heard
        self.points: dict[str, Point] = {}
        """By address; new ones are added as they appear."""
        self._robot = robot
        self._by = by.encode(errors="replace")
        found = addresses(robot)  # before the socket: the process may be at its limit of open files
        self._shared = _socket()
        """For addresses without a socket of their own, when the process may open no more."""
        self._poll = select.poll()
        self._poll.register(self._shared, select.POLLIN)
        self._lines = {self._shared.fileno(): self._shared}
        self._on_line: dict[int, Point] = {}
        """By the file descriptor of its socket."""
        self._send_all(found)

    def __enter__(self) -> Asking:
        return self

    def __exit__(self, *_: object) -> None:
        for line in self._lines.values():
            line.close()

    def go_on(self, until_s: float) -> None:
        """Receives answers, and sends again to addresses that had no room or do not answer, until `until_s` (monotonic)
        or until all have answered."""
        look_s = time.monotonic() + LOOK_AGAIN_S
        while (now_s := time.monotonic()) < until_s:
            all_answered = not self.waiting
            if all_answered or now_s >= look_s:
                with suppress(OSError):  # the process may open no file now; answers are received all the same
                    self._send_all(addresses(self._robot))
                if all_answered and not self.waiting:
                    return
                look_s = time.monotonic() + LOOK_AGAIN_S
            self._hear(min(until_s, look_s) - time.monotonic())

    @property
    def waiting(self) -> list[Point]:
        """Addresses that have not reported to be latched."""
        return [point for point in self.points.values() if point.latched_ns is None and not point.gone]

    def hear_of_the_disk(self, until_s: float) -> None:
        """Receives, until `until_s` at the latest, whether the latches of all latched addresses are on the disk."""
        while (left_s := until_s - time.monotonic()) > 0 and any(
            point.latched_ns is not None and not point.settled for point in self.points.values()
        ):
            self._hear(left_s)

    def _send_all(self, found: dict[str, int | None]) -> None:
        for address, owner in found.items():
            if address not in self.points:
                with suppress(ValueError):  # an address of another form, made by another program
                    self.points[address] = Point(address, owner)
        for point in self.waiting:
            if point.sent_s is None or time.monotonic() - point.sent_s > TELL_AGAIN_S:
                self._send(point)

    def _send(self, point: Point) -> None:
        try:
            self._line_to(point).sendto(self._by, point.address)
            point.sent_s = time.monotonic()
        except OSError as error:  # any other error (a full queue, no memory) passes: it is sent again
            point.gone = error.errno in ENDED
        if point.line is not None:  # in a flood there is room only for a moment
            awaits_room = point.sent_s is None and not point.gone
            self._poll.modify(point.line, select.POLLIN | (select.POLLOUT if awaits_room else 0))

    def _line_to(self, point: Point) -> socket.socket:
        """A socket on which only this address can answer, so that no other fills the queue of its answers."""
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
        """Waits for answers, for at most `wait_s`, and reads up to `AT_ONCE` from each socket, so that a sender that
        never ceases does not keep the others from being heard."""
        for fd, events in self._poll.poll(max(wait_s * 1000.0, 0.0)):
            if events & select.POLLOUT:
                self._send(self._on_line[fd])
            with suppress(OSError):
                for _ in range(AT_ONCE):
                    ancillary_bytes = socket.CMSG_SPACE(_CREDENTIALS.size)
                    text, ancillary, _, sender = self._lines[fd].recvmsg(TEXT_BYTES, ancillary_bytes)
                    self._answered(text, ancillary, sender)

    def _answered(self, text: bytes, ancillary: list[tuple[int, int, bytes]], sender: object) -> None:
        """Counts an answer if it comes from an address that was sent to, and from the user who owns that address."""
        if not isinstance(sender, bytes):
            return
        point = self.points.get("@" + sender[1:].decode(errors="replace"))
        if point is None or _uid(ancillary) != point.uid:
            return
        plain = "".join(character for character in text.decode(errors="replace") if character.isprintable())
        word, _, rest = plain.partition(" ")
        about = rest.partition(" ")[2]
        if word == "latched" and about.isascii() and about.isdecimal() and point.latched_ns is None:
            point.latched_ns = int(about)
            if self._heard is not None:
                self._heard(point)
        elif word in ("kept", "unkept"):
            point.kept, point.why_not_kept, point.settled = word == "kept", about, True
        elif word == "keepless":
            point.settled = True


def addresses(robot: str | None = None) -> dict[str, int | None]:
    """The addresses of the stop path on this machine, of all robots or of one name, each with the user who owns it
    (None where the kernel does not say). This user's come first.

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
    """A datagram socket with an address that the kernel chose."""
    one = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        one.bind(b"")
    except OSError:
        one.close()
        raise
    return one


def _raw(address: str) -> bytes:
    """An address as system calls take it; the kernel lists the leading zero byte as @."""
    return b"\0" + address[1:].encode()


def _uid(ancillary: list[tuple[int, int, bytes]]) -> int | None:
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS) and len(data) >= _CREDENTIALS.size:
            return int(_CREDENTIALS.unpack_from(data)[1])
    return None


def owners(prefix: bytes) -> dict[bytes, int]:
    """The user ids of the Unix sockets whose address begins with `prefix`, by address, from the kernel (sock_diag(7)):
    the address itself says only what its maker chose. Empty where the kernel does not say."""
    found: dict[bytes, int] = {}
    with (
        suppress(OSError, struct.error),
        closing(socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _SOCK_DIAG)) as kernel,
    ):
        kernel.settimeout(_PATIENCE_S)
        question = _REQUEST.pack(socket.AF_UNIX, 0, 0, 0xFFFFFFFF, 0, _SHOW_NAME_AND_USER, 0, 0)
        kernel.send(_HEADER.pack(_HEADER.size + len(question), _BY_FAMILY, _DUMP_REQUEST, 1, 0) + question)
        while _take(kernel.recv(_MOST_BYTES), prefix, found):
            pass
    return found


def _take(data: bytes, prefix: bytes, found: dict[bytes, int]) -> bool:
    """Reads one packet of entries into `found`; False after the last."""
    at = 0
    while at < len(data):
        length, kind, *_ = _HEADER.unpack_from(data, at)
        if kind != _BY_FAMILY or length < _HEADER.size:
            return False
        attributes = {}
        inside = at + _HEADER.size + _ABOUT_BYTES
        while inside < at + length:
            size, name = _ATTRIBUTE.unpack_from(data, inside)
            attributes[name] = data[inside + _ATTRIBUTE.size : inside + size]
            inside += max((size + 3) & ~3, _ATTRIBUTE.size)
        if attributes.get(_NAME, b"").startswith(prefix) and len(attributes.get(_USER, b"")) == 4:
            found[attributes[_NAME]] = int.from_bytes(attributes[_USER], sys.byteorder)
        at += (length + 3) & ~3
    return True
