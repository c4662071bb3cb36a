"""The base service's end of the guard: starts the guard's process, talks to it, and replaces it when it dies or
hangs."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import msgspec
import serial

from cocoro.child import ChildProcess, wait_or_kill
from services.base import oi
from services.base.driver import GuardReport

log = logging.getLogger("cocoro.base")

LATE_S, HANGS_S = 0.12, 0.25
"""A guard reports at least 20 times a second. When a report is later than the first time (or, at high wheel speeds,
than the shorter `patience_s`), this process writes a stop to the port itself; a guard that was only slow undoes that
with its next command. A guard that is silent for the second time hangs, and is killed."""
START_S = 5.0
"""Time in which a new guard must report first, on a busy machine. Until then it has turned no wheels."""
AGAIN_S = 1.0
"""A guard that dies sooner than this after its start is not replaced before this time is over."""
END_S = 2.0
_REPORT = msgspec.json.Decoder(GuardReport)
PYSERIAL = str(Path(serial.__file__).parents[1])
"""Pyserial's folder: the only third-party package that the guard imports."""


class GuardSupervisor:
    """Use it as an asynchronous context manager. Calls `on_report(report)` in the event loop."""

    def __init__(
        self, port: str, mode: str, deadman_s: float, on_report: Callable[[GuardReport], None], robot: str | None = None
    ) -> None:
        """`robot`: name of the robot whose emergency stop the guard listens to; None: it listens to none."""
        self.starts = 0
        self._port = port
        self._arguments = ["--mode", mode, "--deadman-ms", str(round(deadman_s * 1000))]
        self._arguments += ["--robot", robot] if robot else []
        self._on_report = on_report
        self._guard: ChildProcess | None = None
        self._ended = False
        self._started_s = 0.0
        self._reported_s = 0.0
        self._late = False
        self._late_s = LATE_S

    async def __aenter__(self) -> GuardSupervisor:
        self._start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended = True
        guard, self._guard = self._guard, None
        if guard is not None:
            guard.close()  # the guard then stops the wheels and ends
            await asyncio.get_running_loop().run_in_executor(None, wait_or_kill, guard.process, END_S)

    @property
    def pid(self) -> int | None:
        return None if self._guard is None else self._guard.process.pid

    def ask(self, left_mmps: int, right_mmps: int, for_ns: int, reset: int = 0, patience_s: float = LATE_S) -> None:
        """Ask for wheel speeds, for `for_ns` from now. Must be called again and again: that keeps the wheels turning.

        `reset`: how many of the emergency stops that the guard received have been reset. `patience_s`: how late a
        report of the guard may be at these speeds.
        """
        self._late_s = min(patience_s, LATE_S)
        self._send({"left": left_mmps, "right": right_mmps, "until": time.monotonic_ns() + for_ns, "reset": reset})

    def halt(self) -> None:
        """Ask for speed zero, from any thread."""
        self._send({"left": 0, "right": 0, "until": time.monotonic_ns()})

    def recover(self) -> None:
        """Ask the guard to put a Create that left its mode back into it."""
        self._send({"recover": True})

    def check(self) -> None:
        """Replace a guard that has died or hangs. Must be called every few heartbeats."""
        now_s = time.monotonic()
        if self._guard is not None:
            self._guard.read()  # a report that waits to be read is no silence
        if self._ended:
            return
        if self._guard is None:
            if now_s - self._started_s > AGAIN_S or self.starts < 2:
                self._start()
            return
        silent_s = now_s - (self._reported_s or self._started_s + START_S)
        if silent_s > HANGS_S:
            self._replace("the guard of the port hangs")
        elif silent_s > self._late_s and not self._late:
            self._late = True
            _write(self._port, oi.drive_direct(0, 0))

    def _start(self) -> None:
        # Without site packages it starts within milliseconds and stays small.
        self._guard = ChildProcess(
            "services.base.guard", self._port, *self._arguments, packages=(PYSERIAL,), site_packages=False
        )
        self._started_s = time.monotonic()
        self._reported_s = 0.0
        self._late = False
        self.starts += 1
        self._guard.watch(self._take_report, lambda: self._replace("the guard of the port died"))

    def _take_report(self, message: bytes) -> None:
        self._reported_s = time.monotonic()
        self._late = False
        self._on_report(_REPORT.decode(message))

    def _replace(self, why: str) -> None:
        """Stop the wheels, which nobody guards any more, then start another guard."""
        guard, self._guard = self._guard, None
        if guard is not None:
            guard.close()
        _write(self._port, oi.halt())  # first of all: this process may be killed between any two of these lines
        if guard is not None:
            guard.process.kill()
            asyncio.get_running_loop().run_in_executor(None, guard.process.wait)
        _write(self._port, oi.halt())
        log.error("%s; the wheels were stopped, and another guard is started", why)
        self._on_report(GuardReport(t=time.monotonic_ns(), link="closed", why=why, left=0, right=0))
        self.check()

    def _send(self, message: dict[str, int | bool]) -> None:
        if (guard := self._guard) is not None:
            guard.send(json.dumps(message).encode())  # a guard that is dead is noticed by its silence


def _write(port: str, command: bytes) -> None:
    """Write to the port although another process has it open; its settings are still in force."""
    with suppress(OSError):
        fd = os.open(port, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            os.write(fd, command)
        finally:
            os.close(fd)
