"""Standard streams of the process `cocoro` that survive anything: closed, full, abandoned by their reader, or with an
encoding that lacks a character.

Standard error never raises. Standard output raises `OutputError` once, in the write that finds it lost, and discards
all later writes, so that a command can still clean up. Inside `going_on` it does not raise at all. In both cases
`finish` reports the loss in one line and turns it into an exit code.

This module imports little, because the emergency stop uses it.
"""

from __future__ import annotations

import codecs
import errno
import io
import os
import sys
from collections import deque
from contextlib import contextmanager, suppress

from apps.cli import exits

TYPE_CHECKING = False
"""As in `typing`, which takes 2 ms to import."""
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any, TextIO

LEVEL = "COCORO_LOG"
"""Environment variable with the log level; at `debug`, errors are printed with their tracebacks."""
SPELLING = "cocoro.spelling"
"""Name under which `codecs` knows the streams' error handler."""
PIECE = 4096
"""Bytes that a pipe which has room takes at once."""
HURRIED_S = 0.1
UNREAD = OSError(errno.EAGAIN, "its reader reads nothing")
CLOSED = OSError(errno.EBADF, "it is closed")
ADVICE = {
    errno.ENOSPC: "make room there, or write it elsewhere",
    errno.EBADF: "redirect it to /dev/null to do without it",
    errno.EPIPE: "its reader ended before it read anything",
    errno.EAGAIN: "read it, or write it elsewhere",
}


class OutputError(Exception):
    """Standard output takes nothing more. Not an OSError, so that it is not mistaken for the error of a file."""


class _Out(io.RawIOBase):
    """Writes to a file descriptor; after a failure it discards everything."""

    mode = "wb"

    def __init__(self, fd: int, name: str, *, vital: bool, closed: bool) -> None:
        self.name = name
        self.vital = vital
        """Whether a failed write raises OutputError."""
        self.failure: OSError | None = None
        self.arrived = False
        """Whether any byte was written."""
        self.interruptible = False
        """Whether `give_up_waiting` ends a write that waits for a reader."""
        self.hurried = False
        """Whether no write waits for longer than HURRIED_S: the command is being ended."""
        self.waits = False
        """Whether an interruptible write waits now."""
        self._fd = fd
        self._was_closed = closed

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
        if self._was_closed:
            raise CLOSED
        while True:
            if self.interruptible or self.hurried:
                self._wait_for_room()
            try:
                count = os.write(self._fd, data[:PIECE] if self.interruptible or self.hurried else data)
            except BlockingIOError:  # another process set O_NONBLOCK on the shared descriptor
                import select

                select.select([], [self._fd], [])
                continue
            self.arrived = True
            return count

    def _wait_for_room(self) -> None:
        """Waits until the reader takes a piece; the wait can be given up, that of `os.write` could not."""
        import select

        if select.select([], [self._fd], [], HURRIED_S if self.hurried else 0)[1]:
            return
        if self.hurried:
            raise UNREAD
        self.waits = True
        try:
            select.select([], [self._fd], [])
        finally:
            self.waits = False

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._fd

    def isatty(self) -> bool:
        return os.isatty(self._fd)


_outs: dict[str, _Out] = {}
told = False
"""Whether the running command has printed JSON."""
ERRORS = {exits.FAILED: "failed", exits.USAGE: "usage", exits.REFUSED: "refused", exits.NO_MESH: "no_mesh"}
"""Names of the exit codes in errors as JSON."""
recent_complaints: deque[str] = deque(maxlen=8)
"""Latest complaints of the running command, so that none is printed twice."""


def take_over() -> None:
    """Replaces this process's standard streams.

    A closed descriptor becomes /dev/null; otherwise the next opened file would get its number, and with it the text
    that libraries print.
    """
    closed = [fd for fd in range(3) if not _is_open(fd)]
    for _ in closed:
        with suppress(OSError):
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # gets the lowest free number, which is this one
    codecs.register_error(SPELLING, spelt)
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(errors="replace")
    elif sys.stdin is None:
        sys.stdin = open(0, encoding="utf-8", errors="replace", closefd=False)  # noqa: SIM115 # the descriptor stays open
    sys.stdout = _stream(sys.stdout, _Out(1, "<stdout>", vital=True, closed=1 in closed))
    sys.stderr = _stream(sys.stderr, _Out(2, "<stderr>", vital=False, closed=2 in closed))


def taken_over() -> bool:
    """Whether `take_over` was called: true in the process `cocoro`, false in tests of its functions."""
    return bool(_outs)


def _is_open(fd: int) -> bool:
    try:
        os.fstat(fd)
    except OSError:
        return False
    return True


def _stream(before: TextIO | None, out: _Out) -> TextIO:
    """A stream with the encoding and buffering of `before` that writes to `out`."""
    _outs[out.name] = out
    straight = bool(getattr(before, "write_through", False))  # set by PYTHONUNBUFFERED
    raw: Any = out
    return io.TextIOWrapper(
        raw if straight else io.BufferedWriter(raw),
        encoding=getattr(before, "encoding", None) or "utf-8",
        errors=SPELLING,
        line_buffering=bool(getattr(before, "line_buffering", False)) or not out.vital,
        write_through=straight,
    )


def spelt(error: UnicodeError) -> tuple[bytes, int]:
    """Error handler for `codecs`: a file name's undecodable bytes are written as they are, others as `\\xfc`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    found = bytearray()
    for character in error.object[error.start : error.end]:
        if "\udc80" <= character <= "\udcff":  # a byte that the file system's encoding could not decode
            found.append(ord(character) - 0xDC00)
        else:
            found += character.encode("ascii", "backslashreplace")
    return bytes(found), error.end


@contextmanager
def going_on() -> Iterator[None]:
    """Standard output does not raise in this context: lost output must not interrupt a command to a robot, or a
    recording."""
    out = _outs.get("<stdout>")
    before = out is not None and out.vital
    if out is not None:
        out.vital = False
    try:
        yield
    finally:
        if out is not None:
            out.vital = before


def print_json(value: Any) -> None:
    """Prints a result as one line of JSON. A command with `--json` prints all its results by this function; an error
    is printed by `print_json_error`."""
    import json

    global told
    told = True
    try:
        text = json.dumps(value, allow_nan=False)
    except ValueError:  # JSON has no NaN and no infinity
        text = json.dumps(json.loads(json.dumps(value), parse_constant=lambda _: None))
    print(text, flush=True)


def tell(as_json: bool, data: Any, text: str) -> None:
    """Prints a result, as JSON or as text."""
    if as_json:
        print_json(data)
    else:
        print(text, flush=True)


def asks_json(arguments: list[str]) -> bool:
    """Whether a command's arguments ask for JSON."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    return "--json" in arguments[:end]


def json_error(code: int, text: str) -> dict[str, object]:
    """An error for scripts; `code` is the exit code."""
    return {"error": {"code": ERRORS.get(code, "failed"), "exit_code": code, "text": text}}


def print_json_error(code: int, text: str) -> None:
    """Prints an error on standard output for scripts."""
    with going_on():
        print_json(json_error(code, text))


@contextmanager
def interruptible() -> Iterator[None]:
    """Let `give_up_waiting` have an effect in this context."""
    for out in _outs.values():
        out.interruptible = True
    try:
        yield
    finally:
        for out in _outs.values():
            out.interruptible = False


def give_up_waiting(for_good: bool) -> None:
    """Ends a write that waits for a reader, as if the stream were lost; called in a signal handler. `for_good`: no
    later write waits for long."""
    for out in _outs.values():
        out.hurried = out.hurried or for_good
    if any(out.waits for out in _outs.values()):
        raise UNREAD


def finish(code: int) -> int:
    """Flushes the streams and returns the exit code: at least 1 when standard output did not take everything.

    A reader that read something and left, as `head` does, is not reported.
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
        complain(f"standard output: {out.failure.strerror}, so output was lost; {advice}")
    return code or exits.FAILED


def named(error: BaseException) -> str:
    """The error's type and text."""
    return f"{type(error).__name__}: {error}".rstrip(": ")


def show_trace(error: BaseException) -> None:
    """Prints the error's traceback when COCORO_LOG=debug."""
    if os.environ.get(LEVEL, "").lower() == "debug":
        import traceback

        traceback.print_exception(error)


def complain(text: str) -> None:
    """Prints one line on standard error, unless it was just printed; control characters are escaped."""
    line = f"cocoro: {one_line(text)}"
    if line not in recent_complaints:
        recent_complaints.append(line)
        print(line, file=sys.stderr, flush=True)


def one_line(text: str) -> str:
    """The text with line ends and control characters, which a file's name may have, escaped."""
    return "".join(map(_escaped, text))


def _escaped(character: str) -> str:
    plain = character.isprintable() or "\udc80" <= character <= "\udcff"
    return character if plain else character.encode("unicode_escape").decode()


def log_to_stderr() -> None:
    """Prints log records of commands that set up no log, one line each; tracebacks with COCORO_LOG=debug."""
    import logging

    class Lines(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            error = record.exc_info[1] if record.exc_info else None
            if isinstance(error, OutputError):  # `finish` reports it
                return
            first = record.getMessage().partition("\n")[0]
            complain(first if error is None else f"{first}: {named(error)}")
            if error is not None:
                show_trace(error)

    logging.lastResort = Lines(logging.WARNING)
