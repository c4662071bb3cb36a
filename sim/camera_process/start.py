"""Starting the camera's process. Imports little, so that a command can start it before it imports the rest."""

from __future__ import annotations

import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

from cocoro import child

MODULE = "sim.camera_process"


class Started(NamedTuple):
    """The process and this end of its channel (SOCK_SEQPACKET). The process ends when this end closes."""

    process: subprocess.Popen[bytes]
    channel: socket.socket

    def end(self) -> None:
        """End the process at once: it has nothing to keep."""
        self.channel.close()
        self.process.kill()
        self.process.wait()


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
            process = child.start(MODULE, str(theirs.fileno()), pass_fds=(theirs.fileno(),), env=child.environment_for())
        except OSError:
            ours.close()
            raise
    return Started(process, ours)
