"""Who was refused what at a gateway: read from what zenoh's access control and TLS links log.

zenoh (1.10) tells nobody but its log, in lines on the process's standard output, and what it refuses at level `trace`,
beside what it lets pass. `Watch` takes that output over by a pipe, and `Sifter` keeps the lines that matter.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable, Iterator
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
_READ_BYTES = 1 << 20
_MATTERS = (b"unauthorized", b"caching permissions", b" WARN ", b" ERROR ")
_THREAD = re.compile(rb"ThreadId\((\d+)\)")
_WHAT = rb"is unauthorized to (.+?) \((ingress|egress)\)(?: on (\S+))?"
_BY_NAME = re.compile(rb"CertCommonName\(([^)]*)\).* " + _WHAT)
_BY_ID = re.compile(rb"access_control: (?:Using cached result: )?(\S+) .*?" + _WHAT)
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
        thread = _THREAD.search(line)
        if thread is None:
            return None
        if b"caching permissions" in line:
            self._computed[thread[1]] = VERDICTS
            return None
        if left := self._computed.get(thread[1], 0):
            if b"cached result" not in line:
                self._computed[thread[1]] = left - 1
                return None
            del self._computed[thread[1]]
        match = _BY_NAME.search(line) or _BY_ID.search(line)
        if match is None or match[3] == b"egress" or match[2].startswith(b"Undeclare"):
            return None  # what is kept from somebody, nobody did; and who ends what was refused does nothing either
        who, what, key = (part.decode(errors="replace") if part else "" for part in (match[1], match[2], match[4]))
        return Refusal(who, what, key)


class Watch:
    """Takes this process's standard output over, from its making to `close`; for a process that prints nothing.

    `refused` is called with each refusal and `told` with each line of another kind, in a thread of its own.
    """

    def __init__(self, refused: Callable[[Refusal], None], told: Callable[[str], None]) -> None:
        self._refused = refused
        self._told = told
        read_fd, write_fd = os.pipe()
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
        rest = b""
        sifter = Sifter()
        with os.fdopen(fd, "rb", buffering=0) as pipe:
            while part := pipe.read(_READ_BYTES):
                whole, _, rest = (rest + part).rpartition(b"\n")
                rest = rest[:LONGEST_LINE]
                for found in sifter.sift(whole):
                    if isinstance(found, Refusal):
                        self._refused(found)
                    else:
                        self._told(found)
