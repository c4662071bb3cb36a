"""A Create at the end of a pseudo-terminal, and a driver for it: the common part of the base's tests."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from cocoro.child import ChildProcess
from services.base import oi
from services.base.guard_supervisor import PYSERIAL
from sim.wire.create import EmulatedCreate
from sim.wire.emulator import Emulator, SimplePlant

MS = 1_000_000
SAFE = 2
DEADMAN_NS = 200 * MS
PATIENCE_NS = 100 * MS
"""Time that a busy machine may add to a deadline."""


def frame(readings: oi.Readings) -> bytes:
    """A stream frame of the Create."""
    payload = b"".join(
        bytes([packet]) + value.to_bytes(oi.PACKETS[packet].size, "big", signed=oi.PACKETS[packet].signed)
        for packet, value in readings.items()
    )
    body = bytes([19, len(payload)]) + payload
    return body + bytes([-sum(body) & 0xFF])


class Bench:
    """An emulated Create, its line and its plant; a context manager."""

    def __init__(self, folder: Path, seed: int = 0) -> None:
        self.create = EmulatedCreate()
        self.body = SimplePlant(self.create)
        self.emulator = Emulator(folder, {"create": self.create}, self.body, seed)
        self.line = self.emulator.lines["create"]
        self.port = str(folder / "create")

    def __enter__(self) -> Bench:
        self.emulator.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.emulator.__exit__(None, None, None)

    def until_awake(self) -> None:
        """Whether the driver has put the Create into its mode and requests its sensors."""
        self.emulator.until(lambda: self.create.mode == SAFE and self.create._streaming)

    def until_wheels(self, left: int, right: int) -> int:
        """Wait for these wheel speeds; returns when they were commanded, CLOCK_MONOTONIC."""
        self.emulator.until(lambda: self.create.wheels_mmps == (left, right))
        return self.emulator.call(lambda: self.create.acted[-1][0])

    def forget(self) -> None:
        self.emulator.call(self.create.acted.clear)


class FakeService:
    """Replaces the service: the other end of a guard's socket."""

    def __init__(self, port: str, mode: str = "safe", robot: str = "") -> None:
        arguments = [port, "--mode", mode, *(["--robot", robot] if robot else [])]
        child = ChildProcess("services.base.guard", *arguments, packages=(PYSERIAL,), site_packages=False)
        self.guard, self.channel = child.process, child.channel
        self.channel.settimeout(30.0)
        self._asking = threading.Event()
        self._thread: threading.Thread | None = None
        self.asked_ns = 0
        """Time of the last request."""
        self.reset = 0
        """Number of emergency stops that its requests report as reset."""

    def ask(self, left: int, right: int, for_s: float = 0.2) -> None:
        self.asked_ns = time.monotonic_ns()
        until_ns = self.asked_ns + round(for_s * 1e9)
        self.send({"left": left, "right": right, "until": until_ns, "reset": self.reset})

    def send(self, message: Any) -> None:
        self.channel.send(message if isinstance(message, bytes) else json.dumps(message).encode())

    def report(self, **wanted: object) -> dict[str, Any]:
        """The next report with these values."""
        while True:
            report: dict[str, Any] = json.loads(self.channel.recv(65536))
            if all(report[name] == value for name, value in wanted.items()):
                return report

    def keep_asking(self, left: int, right: int) -> None:
        """Ask for these wheel speeds until `silence`."""
        self.silence()
        self._asking.clear()

        def ask() -> None:
            with suppress(BrokenPipeError, ConnectionResetError):  # the guard has ended
                while not self._asking.wait(0.02):
                    self.ask(left, right)

        self._thread = threading.Thread(target=ask)
        self._thread.start()

    def silence(self) -> None:
        self._asking.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def close(self) -> None:
        self.silence()
        self.channel.close()
        self.guard.wait(10.0)


@contextmanager
def guarded(bench: Bench, mode: str = "safe", robot: str = "") -> Iterator[FakeService]:
    service = FakeService(bench.port, mode, robot)
    try:
        yield service
    finally:
        service.close()
