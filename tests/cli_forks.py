"""Runs the `cocoro` command in many situations at little cost: a process that has imported it, and a fork for each.

Tests use `Forks`. It starts this file as a program that reads one situation per line, as JSON, and answers with the
end of the command. A forked child cannot open a zenoh session, so only commands that end before may be given.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import functools
import gc
import importlib
import io
import json
import logging
import os
import pkgutil
import select
import signal
import subprocess
import sys
import tempfile
import termios
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from cocoro.errors import CocoroError

PATIENCE_S = 60.0
"""Time limit of a command, s; one that takes longer hangs."""
NEW_MOUNTS, PRIVATE, RECURSIVE, READ_ONLY = 0x20000, 1 << 18, 1 << 14, 1
"""Flags of unshare(2) and mount(2)."""
LATER = 7
TALKED = 3
FULL = "size=4k"
"""Options of a small file system, which is then filled."""
NO_MOUNTS = 77
"""Exit code of a child that may not make mounts."""


OFTEN = (
    "services.base.doctor", "services.capture.service", "services.kinect.doctor", "services.kinect.tools",
    "services.servos.doctor", "services.servos.tools", "apps.captures.export.foxglove", "apps.captures.export.video",
)  # fmt: skip
"""Modules that commands import when they are called."""


@dataclass(frozen=True)
class Case:
    """A command and its situation."""

    arguments: list[str]
    folder: str
    """The current directory."""
    stdin: str = "null"
    stdout: str = "kept"
    stderr: str = "kept"
    """kept, null, closed, full (of /dev/full), gone (a pipe that nobody reads) or narrow (a terminal of one column)."""
    unbuffered: bool = False
    encoding: str = "utf-8"
    env: dict[str, str | None] = field(default_factory=dict)
    """Environment variables; None removes one."""
    no_folder: bool = False
    """The current directory is removed."""
    mounts: list[tuple[str, str]] = field(default_factory=list)
    """Places and options of empty file systems (`ro`: read-only) that only the command sees."""
    at_call: int | None = None
    """Number of the Python function call that raises a signal; -1 counts the calls."""
    number: int = signal.SIGINT
    again: bool = False
    """Whether the signal is raised again a few calls later."""
    deaf: bool = False
    """Whether SIGINT is ignored."""
    fresh: bool = False
    """Whether the project's modules must be imported again."""
    instead: tuple[str, str] | None = None
    """A function as `module:name`, and its replacement from this file: `bug`, `talk` or `log`."""


@dataclass(frozen=True)
class Ending:
    """The end of a command."""

    code: int
    """Exit code; negative for a signal."""
    out: str
    err: str
    hung: bool = False
    calls: int = 0


class Forks:
    """A context manager; call it with a Case to run that."""

    def __init__(self, **env: str) -> None:
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | threads | env,
            text=True,
            encoding="ascii",
        )

    def __enter__(self) -> Forks:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait(PATIENCE_S)

    def __call__(self, case: Case) -> Ending:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(asdict(case)), file=self._process.stdin, flush=True)
        return Ending(**json.loads(self._process.stdout.readline()))


# --- the program that forks -----------------------------------------------------------------------


def serve() -> None:
    """Import everything, then run the cases from standard input."""
    with contextlib.redirect_stdout(sys.stderr):
        preload()
    gc.disable()  # garbage collection would touch, and so copy, the memory that the children share
    for line in sys.stdin:
        ending = play(Case(**named_here(json.loads(line))))
        print(json.dumps(asdict(ending)), flush=True)


def named_here(value: Any) -> Any:
    """Decode file names by this process's locale; in the C locale `ü` is two undecodable bytes."""
    if isinstance(value, str):
        return os.fsdecode(value.encode("utf-8", "surrogateescape"))
    if isinstance(value, list):
        return [named_here(each) for each in value]
    return {key: named_here(each) for key, each in value.items()} if isinstance(value, dict) else value


def preload() -> None:
    import typer.main

    typer.main.get_command = functools.cache(typer.main.get_command)  # making them takes most of a command's time
    typer.main.get_group = functools.cache(typer.main.get_group)
    from apps import cli
    from apps.cli.main import main

    for module in pkgutil.iter_modules(cli.__path__, "apps.cli."):
        importlib.import_module(module.name)
    for name in OFTEN:
        with contextlib.suppress(CocoroError):  # an extra that is not installed
            importlib.import_module(name)
    with (
        Path(os.devnull).open("w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        main(["topics", "--help"])
        main(["no-such-command"])


def play(case: Case) -> Ending:
    kept = {name: os.memfd_create(name) for name in ("out", "err")}
    counted = os.memfd_create("calls")
    master, narrow = os.openpty()
    termios.tcsetwinsize(narrow, (24, 1))
    child = os.fork()
    if not child:
        try:
            live(case, kept, narrow, counted)
        except BaseException as error:  # as the interpreter does; the command never returns
            sys.excepthook(type(error), error, error.__traceback__)
        os._exit(99)
    os.close(narrow)
    hung = not ended(child, master, kept["out"])
    if hung:
        os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    texts = {name: os.pread(fd, 1 << 20, 0).decode("utf-8", "surrogateescape") for name, fd in kept.items()}
    calls = int(os.pread(counted, 20, 0) or 0)
    for fd in (master, counted, *kept.values()):
        os.close(fd)
    return Ending(os.waitstatus_to_exitcode(status), texts["out"], texts["err"], hung, calls)


def ended(child: int, master: int, out: int) -> bool:
    """Wait for the end of the child and read its terminal meanwhile; returns whether it ended."""
    pid_fd = os.pidfd_open(child)
    try:
        while True:
            ready, _, _ = select.select([pid_fd, master], [], [], PATIENCE_S)
            if master in ready:
                try:
                    os.write(out, os.read(master, 65536))
                except OSError:  # no process has the terminal any more
                    return bool(select.select([pid_fd], [], [], PATIENCE_S)[0])
            else:
                return pid_fd in ready
    finally:
        os.close(pid_fd)


# --- the child ------------------------------------------------------------------------------------


def live(case: Case, kept: dict[str, int], narrow: int, counted: int) -> None:
    """Become the process `cocoro`, in the state in which the interpreter runs its first line."""
    for name, value in case.env.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    tempfile.tempdir = None  # its cached value is of this process
    mount(case.mounts)
    os.chdir(case.folder)
    if case.no_folder:
        Path(case.folder).rmdir()
    places = {"out": case.stdout, "err": case.stderr}
    fds = [opened(case.stdin, -1, narrow)]
    fds += [opened(place, kept[name], narrow) for name, place in places.items()]
    for number, fd in enumerate(fds):
        if fd is None:
            os.close(number)
        else:
            os.dup2(fd, number)
    os.closerange(3, counted)
    sys.stdin = sys.__stdin__ = stream(0, "r", case)  # type: ignore[misc]
    sys.stdout = sys.__stdout__ = stream(1, "w", case)  # type: ignore[misc]
    sys.stderr = sys.__stderr__ = stream(2, "w", case)  # type: ignore[misc]
    sys.argv = ["cocoro", *case.arguments]
    signal.signal(signal.SIGINT, signal.SIG_IGN if case.deaf else signal.default_int_handler)
    if case.instead is not None:
        module, _, name = case.instead[0].partition(":")
        setattr(importlib.import_module(module), name, {"bug": bug, "talk": talk, "log": log}[case.instead[1]])
    if case.fresh:
        for name in [name for name in sys.modules if name.partition(".")[0] in ("cocoro", "services", "sim", "deploy")]:
            del sys.modules[name]
    from apps.cli.main import run

    if case.at_call is not None:
        signal_at(case, case.at_call, counted)
    run()


def opened(place: str, kept: int, narrow: int) -> int | None:
    """Open the file descriptor of a standard stream; None for a closed one."""
    if place == "gone":
        reader, writer = os.pipe()
        os.close(reader)
        return writer
    files = {"null": os.devnull, "full": "/dev/full"}
    return {"kept": kept, "narrow": narrow, "closed": None}[place] if place not in files else os.open(files[place], 2)


def stream(fd: int, mode: str, case: Case) -> Any:
    try:
        fcntl.fcntl(fd, fcntl.F_GETFD)
    except OSError:
        return None
    errors = "backslashreplace" if fd == 2 else "strict"
    buffering = 0 if case.unbuffered and mode == "w" else -1
    file: Any = open(fd, f"{mode}b", closefd=False, buffering=buffering)  # noqa: SIM115
    text = io.TextIOWrapper(file, encoding=case.encoding, errors=errors, line_buffering=fd == 2 or os.isatty(fd))
    text.reconfigure(write_through=case.unbuffered)
    return text


def mount(wanted: list[tuple[str, str]]) -> None:
    if not wanted:
        return
    libc = ctypes.CDLL(None, use_errno=True)
    failed = libc.unshare(NEW_MOUNTS) or libc.mount(None, b"/", None, RECURSIVE | PRIVATE, None)
    for place, options in wanted:
        flags = READ_ONLY if options == "ro" else 0
        data = b"" if options == "ro" else options.encode()
        failed = failed or libc.mount(b"none", os.fsencode(place), b"tmpfs", flags, data)
        if options == FULL and not failed:
            (Path(place) / "full").write_bytes(bytes(4096))
    if failed:
        os._exit(NO_MOUNTS)


def bug(*_: object, **__: object) -> None:
    raise ZeroDivisionError("a bug\nof two lines")


def talk(*_: object) -> int:
    """A command that prints much, unbuffered, and ends."""
    for line in range(3):
        for stream in (sys.stdout, sys.stderr):
            print(line, file=stream, flush=True)
    return TALKED


def log(*_: object) -> str:
    """Log a fault as a library does that continues, such as the event loop."""
    logging.getLogger("asyncio").error("a callback failed\nwith details", exc_info=ValueError("of two\nlines"))
    return ""


def signal_at(case: Case, at_call: int, counted: int) -> None:
    """Raise a signal in the nth call of a Python function."""
    calls = 0
    wanted = {at_call, at_call + LATER if case.again else at_call}

    def trace(_frame: FrameType, event: str, _argument: Any) -> None:
        nonlocal calls
        if event == "call":
            calls += 1
            if calls in wanted:
                wanted.remove(calls)
                if not wanted:
                    sys.setprofile(None)
                signal.raise_signal(case.number)
            elif at_call < 0:
                os.pwrite(counted, str(calls).encode(), 0)

    sys.setprofile(trace)


if __name__ == "__main__":
    serve()
