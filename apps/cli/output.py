"""Standard input, output and error of the process `cocoro`, whatever they are: closed, full, left by their reader, or
of an encoding that cannot spell what is said.

Standard error never raises: there is nobody left to tell. Standard output raises `OutputError`, once, in the write that
finds it lost; what is written afterwards is discarded, so that a command ends in good order. Under `going_on` it does
not even raise. Either way `finish` says it in one line and makes it an exit code.

Little is imported here: the emergency stop comes this way, too.
"""

from __future__ import annotations

import codecs
import errno
import io
import os
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from apps.cli import exits

LEVEL = "COCORO_LOG"
"""Environment variable with the log level; `debug` shows the tracebacks of errors that were told in a line."""
SPELLING = "cocoro.spelling"
"""The error handler of both streams, by the name that `codecs` knows it by."""
CLOSED = OSError(errno.EBADF, "it is closed")
ADVICE = {
    errno.ENOSPC: "make room there, or write it elsewhere",
    errno.EBADF: "to do without it, say >/dev/null",
    errno.EPIPE: "its reader ended before it read anything",
}


class OutputError(Exception):
    """Standard output takes nothing more. It is no OSError, so that nobody takes it for that of a file."""


class _Out(io.RawIOBase):
    """A file descriptor that takes everything, if only to discard it."""

    mode = "wb"

    def __init__(self, fd: int, name: str, *, vital: bool, closed: bool) -> None:
        self.name = name
        self.vital = vital
        """Whether a write that fails is to raise."""
        self.failure: OSError | None = None
        self.arrived = False
        """Whether anything has been taken."""
        self._fd = fd
        self._is_closed = closed

    def write(self, data: bytes, /) -> int:  # type: ignore[override]
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and self.failure is None:
                rest = rest[self._some(rest) :]
        except OSError as error:
            self.failure = error
            if self.vital:
                raise OutputError(str(error)) from error
        return size

    def _some(self, data: memoryview) -> int:
        if self._is_closed:
            raise CLOSED
        while True:
            try:
                count = os.write(self._fd, data)
            except BlockingIOError:  # somebody else has made it so, at the pipe's other end or before us
                import select

                select.select([], [self._fd], [])
                continue
            self.arrived = True
            return count

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._fd

    def isatty(self) -> bool:
        return os.isatty(self._fd)


_outs: dict[str, _Out] = {}
said_already: deque[str] = deque(maxlen=8)
"""The last complaints of the command that runs."""


def take_over() -> None:
    """Put what bears everything in the place of this process's standard streams.

    A descriptor that is closed becomes /dev/null: else the next file that is opened would get its number, and what a
    library prints.
    """
    closed = [fd for fd in range(3) if not _is_open(fd)]
    for _ in closed:
        with suppress(OSError):
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # it gets the least number that is free: this one
    codecs.register_error(SPELLING, spelt)
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(errors="replace")
    elif sys.stdin is None:
        sys.stdin = open(0, encoding="utf-8", errors="replace", closefd=False)  # noqa: SIM115 # a number
    sys.stdout = _stream(sys.stdout, _Out(1, "<stdout>", vital=True, closed=1 in closed))
    sys.stderr = _stream(sys.stderr, _Out(2, "<stderr>", vital=False, closed=2 in closed))


def taken_over() -> bool:
    """Whether the standard streams are those of `take_over`: this is the process `cocoro`, and no test of it."""
    return bool(_outs)


def _is_open(fd: int) -> bool:
    try:
        os.fstat(fd)
    except OSError:
        return False
    return True


def _stream(before: TextIO | None, out: _Out) -> TextIO:
    """As Python made it, but for what it does when it fails."""
    _outs[out.name] = out
    straight = bool(getattr(before, "write_through", False))  # as PYTHONUNBUFFERED has it
    raw: Any = out
    return io.TextIOWrapper(
        raw if straight else io.BufferedWriter(raw),
        encoding=getattr(before, "encoding", None) or "utf-8",
        errors=SPELLING,
        line_buffering=bool(getattr(before, "line_buffering", False)) or not out.vital,
        write_through=straight,
    )


def spelt(error: UnicodeError) -> tuple[bytes, int]:
    """How what an encoding lacks is written: of a file name the very bytes that it has, else as `\\xfc`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    found = bytearray()
    for character in error.object[error.start : error.end]:
        if "\udc80" <= character <= "\udcff":  # a byte that was none of the file system's encoding
            found.append(ord(character) - 0xDC00)
        else:
            found += character.encode("ascii", "backslashreplace")
    return bytes(found), error.end


@contextmanager
def going_on() -> Iterator[None]:
    """While a robot is commanded or recorded: that nobody hears of it any more must not end it half done."""
    out = _outs.get("<stdout>")
    before = out is not None and out.vital
    if out is not None:
        out.vital = False
    try:
        yield
    finally:
        if out is not None:
            out.vital = before


def finish(code: int) -> int:
    """Write what waits to be written; the exit code, which is 1 at least when standard output has not taken all of it.

    A reader who has read something and left, as `head` does, is not told of: he has what he wanted.
    """
    with going_on():
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError, AttributeError, OutputError):
                stream.flush()
    out = _outs.get("<stdout>")
    if out is None or out.failure is None:
        return code
    number = out.failure.errno or 0
    if number != errno.EPIPE or not out.arrived:
        advice = ADVICE.get(number, "write it elsewhere")
        complain(f"standard output: {out.failure.strerror}, so not all that was to be said has been; {advice}")
    return code or exits.FAILED


def named(error: BaseException) -> str:
    """An error's type and text."""
    return f"{type(error).__name__}: {error}".rstrip(": ")


def show_trace(error: BaseException) -> None:
    """Print an error's traceback, when it is asked for."""
    if os.environ.get(LEVEL, "").lower() == "debug":
        import traceback

        traceback.print_exception(error)


def complain(text: str) -> None:
    """One line on standard error, whatever characters are in it; once, though a library may have said it already."""
    line = f"cocoro: {one_line(text)}"
    if line not in said_already:
        said_already.append(line)
        print(line, file=sys.stderr, flush=True)


def one_line(text: str) -> str:
    """A text with its line ends and control characters, which a file's name may have, written out."""
    return "".join(map(_shown, text))


def _shown(character: str) -> str:
    plain = character.isprintable() or "\udc80" <= character <= "\udcff"
    return character if plain else character.encode("unicode_escape").decode()
