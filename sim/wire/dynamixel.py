"""Emulated Dynamixel AX-12 and RX-28 servos, Protocol 1.0. Pure.

Source: ROBOTIS AX-12 manual and the RX-28's e-manual (the same addresses).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from cocoro.clock import NS
from sim.wire.servo import PING, READ, WRITE, Cell, EmulatedServo, Motor, Places

VOLTAGE, ANGLE_LIMIT, OVERHEATING, RANGE, CHECKSUM, OVERLOAD, INSTRUCTION = (1 << bit for bit in range(7))
OVERLOAD_SHARE = 0.98
TABLE: dict[int, Cell] = {
    0: Cell(2, 12), 2: Cell(1, 24), 3: Cell(1, 1, 0, 253), 4: Cell(1, 1, 0, 254), 5: Cell(1, 250, 0, 254),
    6: Cell(2, 0, 0, 1023), 8: Cell(2, 1023, 0, 1023), 11: Cell(1, 70, 0, 150), 12: Cell(1, 60, 50, 250),
    13: Cell(1, 140, 50, 250), 14: Cell(2, 1023, 0, 1023), 16: Cell(1, 2, 0, 2), 17: Cell(1, 36, 0, 127),
    18: Cell(1, 36, 0, 127), 24: Cell(1, 0, 0, 1), 25: Cell(1, 0, 0, 1), 26: Cell(1, 1, 0, 254),
    27: Cell(1, 1, 0, 254), 28: Cell(1, 32, 1, 254), 29: Cell(1, 32, 1, 254), 30: Cell(2, 512, 0, 1023),
    32: Cell(2, 0, 0, 1023), 34: Cell(2, 1023, 0, 1023), 36: Cell(2, 512), 38: Cell(2, 0), 40: Cell(2, 0),
    42: Cell(1, 120), 43: Cell(1, 30), 44: Cell(1, 0), 46: Cell(1, 0), 47: Cell(1, 0, 1, 1), 48: Cell(2, 32, 0, 1023),
}  # fmt: skip


class EmulatedDynamixel(EmulatedServo):
    """An AX-12 or RX-28."""

    TABLE = TABLE
    AT = Places(
        number=3, delay=5, level=16, max_torque=14, torque=24, goal=30, speed=32, limit=34, position=36, volts=42,
        heat=43, waiting=44,
    )  # fmt: skip
    ROM_END = 24
    MODELS: ClassVar[Mapping[int, Mapping[int, int]]] = {12: {}, 28: {0: 28, 11: 80, 13: 240}}
    TURN_COUNTS, SPEED_RPM, FULL_RPM = 1023 * 360 / 300, 0.111, 59.0
    BROWN_OUT_V = 6.0
    CHECKSUM = CHECKSUM
    LEVELS: ClassVar[Mapping[int, int]] = {PING: 0, READ: 1, WRITE: 2}

    def __init__(self, number: int, model: int = 12, overload_s: float = 5.0) -> None:
        super().__init__(number, model, overload_s)

    @property
    def baud(self) -> int:
        return round(2_000_000 / (self.get(4) + 1))

    @property
    def motor(self) -> Motor:
        return Motor(
            on=bool(self.get(24)) and self.powered,
            goal=self.get(30),
            speed=self.get(32),
            limit=self.get(34) / 1023,
            slope=self.get(28),
            punch=self.get(48) / 1023,
        )

    def sense(self, shaft: int, speed: int, load: float, now_ns: int) -> None:
        self.put(36, min(max(shaft, 0), 1023))
        self.put(38, _signed(speed))
        self.put(40, _signed(round(load * 1023)))
        self.put(46, int(abs(speed) > 0))
        limit = self.get(34) / 1023
        if not self.get(24) or limit <= 0.0 or abs(load) < OVERLOAD_SHARE * limit:
            self._straining_ns = None
        elif self._straining_ns is None:
            self._straining_ns = now_ns
        elif now_ns - self._straining_ns > self.overload_s * NS:
            self.trip(OVERLOAD)

    def trip(self, error: int) -> None:
        self._tripped |= error
        if error & self.get(18):
            self.put(24, 0)
            self.put(34, 0)

    @property
    def error(self) -> int:
        volts = self.get(42)
        error = self._tripped
        if not self.get(12) <= volts <= self.get(13):
            error |= VOLTAGE
        if self.get(43) > self.get(11):
            error |= OVERHEATING
        return error

    def obey(self, instruction: int, data: bytes, now_ns: int) -> tuple[int, bytes] | None:
        if self.error & OVERHEATING:
            self.trip(OVERHEATING)
        return super().obey(instruction, data, now_ns)

    def _refused(self, why: str) -> int:
        return RANGE if why == "range" else INSTRUCTION

    def _write(self, address: int, values: bytes, now_ns: int) -> int:
        changes: list[tuple[int, int]] = []
        end = address + len(values)
        at = address
        while at < end:
            cell = TABLE.get(at)
            if cell is None or at + cell.size > end:
                return RANGE
            value = int.from_bytes(values[at - address : at - address + cell.size], "little")
            if not cell.low <= value <= cell.high or (at < self.ROM_END and self.get(47)):
                return RANGE
            if at == 30 and not self.get(6) <= value <= self.get(8):
                return ANGLE_LIMIT
            changes.append((at, value))
            at += cell.size
        for at, value in changes:
            self.put(at, value)
            self.acted.append((now_ns, at, value))
            if at == 30:
                self.put(24, 1)
            elif at == 14:
                self.put(34, value)
            elif at == 34 and value:
                self._tripped = 0
        return 0


def _signed(value: int) -> int:
    """Encode a speed or load: ten bits, and the sign in the eleventh."""
    return min(abs(value), 1023) | (1024 if value < 0 else 0)
