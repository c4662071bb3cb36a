"""The line's service's end of the guard of its wheels (`services.servos.guard`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

import msgspec

from cocoro.base import Base
from cocoro.child import ChildProcess
from cocoro.clock import NS
from cocoro.guarding import HANGS_S, GuardKeeper
from services.servos.family import ServoFamily
from services.servos.wheel_orders import WheelOrders

BROADCAST, SYNC_WRITE = 254, 0x83
SLOWEST_MPS = 1e-4
"""Wheels that are ordered to turn more slowly stand: a servo's lowest speed is 0.08 mm/s at the rim."""


class Report(msgspec.Struct):
    """A report of the guard."""

    t: int
    """CLOCK_MONOTONIC, ns."""
    stops: int
    """Count of emergency stops that it received on its own address."""
    why: str = ""
    """Why it cannot write to the port; '' when it can."""


_REPORT = msgspec.json.Decoder(Report)


def packet_to_all(family: ServoFamily, register: str, numbers: Iterable[int], value: int = 0) -> bytes:
    """The packet that writes a value to a register of these servos, which they do not answer."""
    row = family.registers[register]
    values = b"".join(bytes([number]) + value.to_bytes(row.size, "little") for number in numbers)
    body = bytes([BROADCAST, len(values) + 4, SYNC_WRITE, row.address, row.size]) + values
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


class WheelGuard(GuardKeeper):
    """Use it as an asynchronous context manager. Calls in the event loop: `on_report(report)`, and `on_lost(why)` when
    the guard died or hangs. Nothing lets the wheels turn but a report: see `WheelOrders.guarded`."""

    def __init__(
        self,
        port: str,
        baud: int,
        family: ServoFamily,
        base: Base,
        orders: WheelOrders,
        on_report: Callable[[Report], None],
        on_lost: Callable[[str], None],
        robot: str | None = None,
    ) -> None:
        """`robot`: name of the robot whose emergency stop the guard listens to; None: it listens to none."""
        super().__init__()
        stop = packet_to_all(family, "moving_speed", orders.numbers)
        limp = packet_to_all(family, "torque_enable", orders.numbers)
        self._arguments = [port, "--baud", str(baud), "--stop", stop.hex(), "--limp", limp.hex()]
        self._arguments += ["--robot", robot] if robot else []
        self._base = base
        self._orders = orders
        self._on_report = on_report
        self._on_lost = on_lost
        orders.vouch_by(self.vouch)

    def vouch(self, fastest_mps: float) -> None:
        """The wheels' speeds were written. Called in the line's thread."""
        until_ns = time.monotonic_ns() + round(self._base.patience_s(fastest_mps) * NS)
        self._send({"until": until_ns, "turning": fastest_mps > SLOWEST_MPS})

    def reset(self, stops: int) -> None:
        """So many of the emergency stops that the guard received have been reset."""
        self._send({"reset": stops})

    def _child(self) -> ChildProcess:
        return ChildProcess("services.servos.guard", *self._arguments, site_packages=False)

    def _heard(self, message: bytes) -> None:
        report = _REPORT.decode(message)
        if not report.why:
            self._orders.guarded(report.t + round(HANGS_S * NS))
        self._on_report(report)

    def _halt(self, *, for_good: bool) -> None:
        if for_good:  # one that is only late holds for `HANGS_S` more, in the line's thread
            self._orders.guarded(0)

    def _lost(self, why: str) -> None:
        self._on_lost(why)
