"""The service's end of the guard: starts it, talks to it, and starts it again when it dies or hangs."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import msgspec
import serial

from services.base import oi
from services.base.driver import Report

log = logging.getLogger("cocoro.base")

LATE_S, HANGS_S = 0.12, 0.25
"""A guard reports at least twenty times a second. One that is late (sooner, where the wheels turn fast) has the wheels
stopped past it, which it puts right at once when it was only slow; one that hangs is killed."""
START_S = 5.0
"""So long a guard may take to report first, on a busy machine. Before that it has turned no wheels."""
AGAIN_S = 1.0
"""A guard that dies sooner is not started again at once."""
_REPORT = msgspec.json.Decoder(Report)
_PACKAGES = (str(Path(__file__).parents[2]), str(Path(serial.__file__).parents[1]))


class Guardian:
    """Use it as an asynchronous context manager. `heard(report)` is called in the event loop."""

    def __init__(
        self, port: str, mode: str, deadman_s: float, heard: Callable[[Report], None], robot: str | None = None
    ) -> None:
        """`robot`: whose emergency stop the guard hears by itself."""
        self.starts = 0
        self._port = port
        self._arguments = ["--mode", mode, "--deadman-ms", str(round(deadman_s * 1000))]
        self._arguments += ["--robot", robot] if robot else []
        self._heard = heard
        self._channel: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._ended = False
        self._started_s = 0.0
        self._reported_s = 0.0
        self._late = False
        self._late_s = LATE_S

    async def __aenter__(self) -> Guardian:
        self._start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended = True
        self._let_go()  # which the guard takes for the end, and stops the wheels
        if self._process is not None:
            await asyncio.get_running_loop().run_in_executor(None, _end, self._process)

    @property
    def pid(self) -> int | None:
        return None if self._process is None else self._process.pid

    def ask(self, left_mmps: int, right_mmps: int, for_ns: int, reset: int = 0, patience_s: float = LATE_S) -> None:
        """Ask for wheel speeds, for so long from now. To be called steadily: it is what keeps the wheels turning.
        `reset`: how many of the emergency stops that the guard heard have been reset. `patience_s`: how long the guard
        may be silent at these speeds."""
        self._late_s = min(patience_s, LATE_S)
        self._send({"left": left_mmps, "right": right_mmps, "until": time.monotonic_ns() + for_ns, "reset": reset})

    def halt(self) -> None:
        """Ask for no speed at all, from any thread."""
        self._send({"left": 0, "right": 0, "until": time.monotonic_ns()})

    def recover(self) -> None:
        self._send({"recover": True})

    def check(self) -> None:
        """Replace a guard that has died or hangs. To be called every few heartbeats."""
        now_s = time.monotonic()
        if self._channel is not None:
            self._read(self._channel)  # what waits to be read is no silence
        if self._ended:
            return
        if self._channel is None:
            if now_s - self._started_s > AGAIN_S or self.starts < 2:
                self._start()
            return
        silent_s = now_s - (self._reported_s or self._started_s + START_S)
        if silent_s > HANGS_S:
            self._lost("the guard of the port hangs")
        elif silent_s > self._late_s and not self._late:
            self._late = True
            _write(self._port, oi.drive_direct(0, 0))

    def _start(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        # No site packages but the one that it needs: it is to be there quickly, and to stay small.
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(dict.fromkeys(_PACKAGES))}
        command = [sys.executable, "-S", "-P", "-m", "services.base.guard", self._port, "--fd", str(theirs.fileno())]
        with theirs:
            self._process = subprocess.Popen(
                command + self._arguments, env=environment, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL
            )
        self._channel = ours
        self._started_s = time.monotonic()
        self._reported_s = 0.0
        self._late = False
        self.starts += 1
        asyncio.get_running_loop().add_reader(ours, self._read, ours)

    def _read(self, channel: socket.socket) -> None:
        while channel is self._channel:
            try:
                message = channel.recv(65536)
            except BlockingIOError:
                return
            except ConnectionError:
                message = b""
            if not message:
                self._lost("the guard of the port died")
                return
            self._reported_s = time.monotonic()
            self._late = False
            self._heard(_REPORT.decode(message))

    def _lost(self, why: str) -> None:
        """What it kept from happening must not happen now: stop the wheels, then start another guard."""
        self._let_go()
        process, self._process = self._process, None
        _write(self._port, oi.halt())  # this process, too, may be killed between any two of these lines
        if process is not None:
            process.kill()
            asyncio.get_running_loop().run_in_executor(None, process.wait)
        _write(self._port, oi.halt())
        log.error("%s; the wheels were told to stop, and another one is started", why)
        self._heard(Report(t=time.monotonic_ns(), link="closed", why=why, left=0, right=0))
        self.check()

    def _let_go(self) -> None:
        channel, self._channel = self._channel, None
        if channel is not None:
            asyncio.get_running_loop().remove_reader(channel)
            channel.close()

    def _send(self, message: dict[str, int | bool]) -> None:
        if (channel := self._channel) is not None:
            with suppress(OSError):  # a dead guard is noticed by its silence
                channel.send(json.dumps(message).encode())


def _write(port: str, command: bytes) -> None:
    """Write past whoever had the port; its settings are still as they were."""
    with suppress(OSError):
        fd = os.open(port, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            os.write(fd, command)
        finally:
            os.close(fd)


def _end(process: subprocess.Popen[bytes]) -> None:
    try:
        process.wait(2.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
