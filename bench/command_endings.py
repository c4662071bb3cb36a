"""A command at a pseudo-terminal, and the ways in which a person or the machine ends it."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress


class Command:
    """`cocoro ...` with a terminal or pipes of its own. `end` ends it or lets go of it."""

    def __init__(self, environment: Mapping[str, str], arguments: list[str], kind: str) -> None:
        self._fds: dict[str, int] = {}
        self.said = bytearray()
        code = [sys.executable, "-m", "apps.cli.main", *arguments]
        out, err = self._stream("out", kind), self._stream("err", kind)
        self.process = subprocess.Popen(
            code, env=environment, stdin=subprocess.DEVNULL if "pipe" in kind else out, stdout=out, stderr=err,
            start_new_session=True, preexec_fn=lambda: _own(out, kind),
        )  # fmt: skip
        for fd in {out, err}:
            os.close(fd)
        for name, fd in self._fds.items():
            if (name, kind) != ("out", "unread pipe, SIGINT"):
                threading.Thread(target=self._drain, args=(fd,), daemon=True).start()

    def _stream(self, name: str, kind: str) -> int:
        if "pipe" not in kind:
            if "terminal" not in self._fds:
                self._fds["terminal"], self._slave = pty.openpty()
            return self._slave if name == "out" else os.dup(self._slave)
        self._fds[name], writer = os.pipe()
        if kind.startswith("unread") and name == "out":
            os.set_blocking(writer, False)
            with suppress(BlockingIOError):
                while True:
                    os.write(writer, bytes(4096))
            os.set_blocking(writer, True)
        return writer

    def _drain(self, fd: int) -> None:
        """Reads what comes. Never waits in `read`, which would keep the pipe open for longer than its number."""
        with suppress(OSError, ValueError):
            while True:
                if select.select([fd], [], [], 0.01)[0]:
                    self.said += (data := os.read(fd, 4096))
                    if not data:
                        return

    def keys(self, *keys: bytes) -> None:
        for key in keys:
            os.write(self._fds["terminal"], key)
            time.sleep(0.05)

    def hang_up(self) -> None:
        os.close(self._fds.pop("terminal"))

    def close_reader(self, name: str) -> None:
        """Closes the reading end; its number stays taken, because a thread reads it."""
        null = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null, self._fds[name])
        os.close(null)

    def finish(self) -> int | None:
        """The exit code; None for one that had to be killed."""
        try:
            code: int | None = self.process.wait(20.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            code = None
        for fd in self._fds.values():
            with suppress(OSError):
                os.close(fd)
        return code


def _own(terminal: int, kind: str) -> None:
    """Prepare the child as a shell does, with a controlling terminal and signals that are heard, though this process
    may run in the background or under nohup; where `kind` says so it ignores a hang-up."""
    if "pipe" not in kind:
        fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    if "unheard" in kind:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)


KINDS: dict[str, Callable[[Command], None]] = {
    "Ctrl-C": lambda command: command.keys(b"\x03"),
    "SIGTERM": lambda command: command.process.send_signal(signal.SIGTERM),
    "terminal closed": Command.hang_up,
    "stdout's reader gone, pipe": lambda command: command.close_reader("out"),
    "SIGKILL": lambda command: command.process.send_signal(signal.SIGKILL),
    "Ctrl-\\": lambda command: command.keys(b"\x1c"),
    "stderr's reader gone, pipe": lambda command: command.close_reader("err"),
    "SIGHUP": lambda command: command.process.send_signal(signal.SIGHUP),
    "terminal gone unheard": Command.hang_up,
    "unread pipe, SIGINT": lambda command: command.process.send_signal(signal.SIGINT),
    "crash (SIGSEGV)": lambda command: command.process.send_signal(signal.SIGSEGV),
    "Ctrl-Z": lambda command: command.keys(b"\x1a"),
    "Ctrl-C twice": lambda command: command.keys(b"\x03", b"\x03"),
}
"""By name, what a person or the machine does. With `pipe` in its name a command has pipes instead of a terminal."""
ENDS = {"SIGKILL": -signal.SIGKILL, "crash (SIGSEGV)": -signal.SIGSEGV}
"""Exit codes that are not those of a cancelled command."""
