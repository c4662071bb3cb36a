"""The base service's end of the guard: starts the guard's process, talks to it, and replaces it when it dies or
hangs."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import serial

from cocoro.child import ChildProcess
from cocoro.guarding import LATE_S, GuardKeeper, write
from services.base import oi
from services.base.driver import GuardReport

_REPORT = msgspec.json.Decoder(GuardReport)
PYSERIAL = str(Path(serial.__file__).parents[1])
"""Pyserial's folder: the only third-party package that the guard imports."""


class GuardSupervisor(GuardKeeper):
    """Use it as an asynchronous context manager. Calls `on_report(report)` in the event loop."""

    def __init__(
        self, port: str, mode: str, deadman_s: float, on_report: Callable[[GuardReport], None], robot: str | None = None
    ) -> None:
        """`robot`: name of the robot whose emergency stop the guard listens to; None: it listens to none."""
        super().__init__()
        self._port = port
        self._arguments = ["--mode", mode, "--deadman-ms", str(round(deadman_s * 1000))]
        self._arguments += ["--robot", robot] if robot else []
        self._on_report = on_report

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

    def _child(self) -> ChildProcess:
        # Without site packages it starts within milliseconds and stays small.
        return ChildProcess(
            "services.base.guard", self._port, *self._arguments, packages=(PYSERIAL,), site_packages=False
        )

    def _heard(self, message: bytes) -> None:
        self._on_report(_REPORT.decode(message))

    def _halt(self, *, for_good: bool) -> None:
        write(self._port, oi.halt() if for_good else oi.drive_direct(0, 0))

    def _lost(self, why: str) -> None:
        self._on_report(GuardReport(t=time.monotonic_ns(), link="closed", why=why, left=0, right=0))
