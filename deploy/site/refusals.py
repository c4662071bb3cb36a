"""Who was refused what at a gateway: read from what zenoh's access control and TLS links log.

zenoh (1.10) tells nobody but its log, in lines on the process's standard output, and what it refuses at level `trace`,
beside what it lets pass. `Watch` takes that output over by a pipe, and `Sifter` keeps the lines that matter.
"""

from __future__ import annotations

import fcntl
import io
import os
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import NamedTuple

import zenoh

LEVELS = ",".join(
    (
        "zenoh::net::routing::interceptor::access_control=trace",
        "zenoh_link_tls=warn",
        "zenoh::net::routing::hat=off",  # its errors are about what was refused before
        "error",
    )
)
LONGEST_LINE = 4096
VERDICTS = 9
"""When a session names a key for the first time, zenoh computes what it may do with it, one line for each kind of
message: nobody did any of that yet."""
PIPE_BYTES = 1 << 20
"""zenoh waits where the pipe is full, and with it the robot's messages: it holds some thousand lines, and reading is
faster than zenoh's writing."""
READ_BYTES = 64 * 1024
"""What is read at once, at most."""
_PAUSE_S = 0.01
"""Between two readings: to wake for each line would cost more than to read it."""
_KNOWN = 4096
"""Lines that are remembered: a flood repeats itself."""
_MATTERS = (b"unauthorized", b"caching permissions", b" WARN ", b" ERROR ")
_WHAT = rb"is unauthorized to (.+?) \((ingress|egress)\)(?: on (\S+))?"
_BY_NAME = re.compile(rb"CertCommonName\(([^)]*)\).* " + _WHAT)
_BY_ID = re.compile(rb"(?:Using cached result: )?(\S+) .*?" + _WHAT)
_HANDSHAKE = re.compile(rb"zenoh_link_tls\S*: (.+)")


class Refusal(NamedTuple):
    """Something that was refused."""

    who: str
    """The certificate's common name, or the session's id; '' for one that was not let in."""
    what: str
    """`Put`, `Query`, `Declare Subscriber` ..., or the reason for which a handshake failed."""
    key: str = ""


class Sifter:
    """Finds the refusals in zenoh's log."""

    def __init__(self) -> None:
        self._computed: dict[bytes, int] = {}
        """By thread, how many verdicts are still to come that are computed in advance."""
        self._known: dict[bytes, Refusal | None] = {}
        """What lines say, without their times."""

    def sift(self, lines: bytes) -> Iterator[Refusal | str]:
        """The refusals in whole lines, and as they are the lines of warnings and errors of another kind."""
        if not any(mark in lines for mark in _MATTERS):
            return
        for line in lines.split(b"\n"):
            if b"access_control" in line:
                refusal = self._verdict(line)
                if refusal is not None:
                    yield refusal
            elif b" WARN " in line or b" ERROR " in line:
                match = _HANDSHAKE.search(line)
                if match is not None:
                    yield Refusal("", match[1].decode(errors="replace").partition(". Hint:")[0])
                else:
                    yield line.decode(errors="replace")

    def _verdict(self, line: bytes) -> Refusal | None:
        head, _, said = line.partition(b"access_control: ")
        thread = head.partition(b"ThreadId(")[2]
        if not thread:
            return None
        if said.find(b"caching permissions") >= 0:
            self._computed[thread] = VERDICTS
            return None
        if left := self._computed.get(thread):
            if not said.startswith(b"Using cached result"):
                self._computed[thread] = left - 1
                return None
            del self._computed[thread]
        if said not in self._known:
            if len(self._known) >= _KNOWN:
                self._known.clear()
            self._known[said] = _refusal(said)
        return self._known[said]


def _refusal(said: bytes) -> Refusal | None:
    match = _BY_NAME.search(said) or _BY_ID.match(said)
    if match is None or match[3] == b"egress" or match[2].startswith(b"Undeclare"):
        return None  # what is kept from somebody, nobody did; and who ends what was refused does nothing either
    who, what, key = (part.decode(errors="replace") if part else "" for part in (match[1], match[2], match[4]))
    return Refusal(who, what, key)


class Watch:
    """Takes this process's standard output over, from its making to `close`; for a process that prints nothing.

    `refused` is called with refusals and how often each came, and `told` with each line of another kind, in a thread of
    its own.
    """

    def __init__(self, refused: Callable[[Counter[Refusal]], None], told: Callable[[str], None]) -> None:
        self._refused = refused
        self._told = told
        read_fd, write_fd = os.pipe()
        with suppress(OSError):  # others of this user have taken all that there is
            fcntl.fcntl(write_fd, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._kept_fd = os.dup(1)
        os.dup2(write_fd, 1)
        os.close(write_fd)
        os.environ["NO_COLOR"] = "1"
        zenoh.init_log_from_env_or(LEVELS)
        self._thread = threading.Thread(target=self._read, args=(read_fd,), name="refusals", daemon=True)
        self._thread.start()

    def close(self) -> None:
        os.dup2(self._kept_fd, 1)
        os.close(self._kept_fd)
        self._thread.join(1.0)

    def _read(self, fd: int) -> None:
        sifter = Sifter()
        with os.fdopen(fd, "rb", buffering=0) as pipe:
            for lines in whole_lines(pipe):
                refused: Counter[Refusal] = Counter()
                for found in sifter.sift(lines):
                    if isinstance(found, Refusal):
                        refused[found] += 1
                    else:
                        self._told(found)
                if refused:
                    self._refused(refused)


def whole_lines(pipe: io.RawIOBase) -> Iterator[bytes]:
    """The lines that come out of a pipe, many at once, until its other end is closed. Of a line longer than
    `LONGEST_LINE` the beginning counts.

    All reads go into one buffer. To have a new one of the pipe's size for each read, as `read` has it, lets the process
    grow by tens of megabytes in minutes: the C library finds room for it in other places each time."""
    buffer = bytearray(READ_BYTES)
    view = memoryview(buffer)
    kept = 0
    while got := pipe.readinto(view[kept:]):
        end = kept + got
        whole = buffer.rfind(b"\n", 0, end) + 1
        if whole:
            yield bytes(view[: whole - 1])
        kept = min(end - whole, LONGEST_LINE)
        view[:kept] = view[whole : whole + kept]
        if end < READ_BYTES:
            time.sleep(_PAUSE_S)
