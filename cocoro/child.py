"""A child process that runs one module of this project: starting it, talking to it over a socket pair, ending it."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

PACKAGES = str(Path(__file__).parents[1])
"""The folder that holds this project's packages."""
MESSAGE_BYTES = 65536


def start(module: str, *arguments: str, site_packages: bool = True, **options: Any) -> subprocess.Popen[bytes]:
    """Start `python -P -m MODULE ARGUMENTS` with an empty standard input; `options` are those of Popen.

    Without `site_packages` (-S) the process is ready sooner and stays smaller, but imports only from PYTHONPATH.
    """
    bare = [] if site_packages else ["-S"]
    command = [sys.executable, *bare, "-P", "-m", module, *arguments]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, **options)


def environment_for(packages: Iterable[str] = (), added: Mapping[str, str] | None = None) -> dict[str, str]:
    """This process's environment with `added`, for a child that imports from this project's folder and `packages`."""
    search_path = os.pathsep.join(dict.fromkeys((PACKAGES, *packages)))
    return {**os.environ, **(added or {}), "PYTHONPATH": search_path}


def wait_or_kill(process: subprocess.Popen[bytes], patience_s: float) -> None:
    """Wait until the process has ended; kill it when that takes longer than `patience_s`. Blocks."""
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()


class ChildProcess:
    """A child that holds one end of a socket pair (SOCK_SEQPACKET: each datagram is a message), given to it as `--fd
    N`.

    The child must end when the other end closes: `close` asks it to end, and so does the death of this process.
    """

    def __init__(
        self,
        module: str,
        *arguments: str,
        packages: Iterable[str] = (),
        environment: Mapping[str, str] | None = None,
        site_packages: bool = True,
        pass_fds: Iterable[int] = (),
        **options: Any,
    ) -> None:
        """`packages`: folders to import from beside this project's. `environment` is added to this process's own."""
        self.channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel.setblocking(False)
        with theirs:
            try:
                self.process = start(
                    module, *arguments, "--fd", str(theirs.fileno()), site_packages=site_packages,
                    env=environment_for(packages, environment),
                    pass_fds=(theirs.fileno(), *pass_fds), **options,
                )  # fmt: skip
            except OSError:
                self.channel.close()
                raise
        self._open = True
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_message: Callable[[bytes], None] = lambda _: None
        self._on_closed: Callable[[], None] = lambda: None

    def watch(self, on_message: Callable[[bytes], None], on_closed: Callable[[], None]) -> None:
        """Call `on_message` with each message, and `on_closed` once when the child has closed its end, as it does when
        it ends. Both are called in the event loop that is running now; this end is closed before `on_closed`."""
        self._on_message, self._on_closed = on_message, on_closed
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self.channel, self.read)

    def read(self) -> None:
        """Handle the messages that wait. The event loop calls this; call it to be sure that none is waiting."""
        while self._open:
            try:
                message = self.channel.recv(MESSAGE_BYTES)
            except BlockingIOError:
                return
            except ConnectionError:
                message = b""
            if not message:
                self.close()
                self._on_closed()
                return
            self._on_message(message)

    def send(self, message: bytes) -> bool:
        """Send a message, from any thread. False when it was lost: the socket is full or the child has ended."""
        with suppress(OSError):
            return self.channel.send(message) == len(message)
        return False

    def close(self) -> None:
        """Close this end. Messages that wait are dropped, and none of the callbacks is called any more."""
        if self._open:
            self._open = False
            if self._loop is not None:
                self._loop.remove_reader(self.channel)
            self.channel.close()
