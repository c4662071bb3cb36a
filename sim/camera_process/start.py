"""Starting the camera's process. Imports little, so that a command can start it before it imports the rest."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol

from cocoro import child

THREADS = Path("/proc/self/task")


class Process(Protocol):
    """The part of `subprocess.Popen` that is used here."""

    def kill(self) -> None: ...

    def wait(self) -> int: ...


class Started:
    """A process and this end of its channel (SOCK_SEQPACKET). The process ends when this end closes."""

    def __init__(self, process: Process, channel: socket.socket) -> None:
        self.channel = channel
        self._process = process
        self._code: int | None = None

    def end(self) -> int:
        """End the process at once, for it has nothing to keep. Returns its exit code; may be called twice."""
        if self._code is None:
            self.channel.close()
            self._process.kill()
            self._code = self._process.wait()
        return self._code


class _Forked:
    """A child that was forked."""

    def __init__(self, pid: int) -> None:
        self._pid = pid

    def kill(self) -> None:
        with suppress(ProcessLookupError):
            os.kill(self._pid, signal.SIGKILL)

    def wait(self) -> int:
        return os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])


_ahead: list[Started] = []


@contextmanager
def started_ahead() -> Iterator[None]:
    """Start the process now for the next call of `take`, so that it gets ready beside what this process still imports.
    It ends with the context if it was not taken."""
    with suppress(OSError):  # `take` tries again, and tells
        _ahead.append(_start())
    try:
        yield
    finally:
        while _ahead:
            _ahead.pop().end()


def take() -> Started:
    """The process that was started ahead, or a new one. Raises OSError when none can be started."""
    return _ahead.pop() if _ahead else _start()


def _start() -> Started:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        try:
            process = _forked(theirs, ours) if _alone() else _spawned(theirs)
        except OSError:
            ours.close()
            raise
    return Started(process, ours)


def _alone() -> bool:
    """Whether this process has one thread: a fork of another might wait for ever for what the others hold."""
    try:
        return len([*THREADS.iterdir()]) == 1
    except OSError:  # not on Linux
        return False


def _forked(channel: socket.socket, owners: socket.socket) -> Process:
    """A copy of this process, which has imported already what it has."""
    pid = os.fork()
    if pid:
        return _Forked(pid)
    try:
        signal.set_wakeup_fd(-1)
        owners.close()  # or its death would go unnoticed
        from sim.camera_process.__main__ import serve

        serve(channel)
    finally:
        os._exit(1)  # `serve` does not return; nothing of the owner's may be finished or flushed here


def _spawned(channel: socket.socket) -> Process:
    number = channel.fileno()
    return child.start("sim.camera_process", str(number), pass_fds=(number,), env=child.environment_for())
