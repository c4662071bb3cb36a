"""Emulated Feetech STS3215 servos. Pure.

Source: Feetech's memory table of the STS series and its protocol manual. Where they leave something open, the choice is
the harder one for a driver: what is wrong is neither answered nor told by an error bit, an overload lasts until the
torque is switched off, the lock is on after power-up, and a servo that has cooled down pushes again by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import copysign
from typing import ClassVar

from cocoro.clock import NS
from sim.wire.servo import PING, READ, WRITE, Cell, EmulatedServo, Motor, Places

VOLTAGE, SENSOR, OVERHEATING, CURRENT, ANGLE, OVERLOAD = (1 << bit for bit in range(6))
BAUDS = (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)
"""By the value of register 6."""
TURN = 4096
CENTRE = 2048
CENTRE_HERE = 128
"""Written into the torque switch, it makes the present position 2048."""
WHEEL = 1
"""The mode in which it turns at its speed for ever."""
ACCELERATION_STEPS = 100
"""Unit of register 41, steps/s^2; 0 is no limit."""
FULL_PUSH = 80
"""Steps from the goal at which it pushes with all its torque, by the factory's gains (about; derived from reports)."""

TABLE: dict[int, Cell] = {
    0: Cell(1, 3), 1: Cell(1, 10), 2: Cell(1, 0), 3: Cell(2, 777), 5: Cell(1, 1, 0, 253), 6: Cell(1, 0, 0, 7),
    7: Cell(1, 0, 0, 254), 8: Cell(1, 1, 0, 1), 9: Cell(2, 0, 0, 4094), 11: Cell(2, 4095, 1, 4095),
    13: Cell(1, 70, 0, 100), 14: Cell(1, 140, 0, 254), 15: Cell(1, 40, 0, 254), 16: Cell(2, 1000, 0, 1000),
    18: Cell(1, 12, 0, 254), 19: Cell(1, 44, 0, 254), 20: Cell(1, 47, 0, 254), 21: Cell(1, 32, 0, 254),
    22: Cell(1, 32, 0, 254), 23: Cell(1, 0, 0, 254), 24: Cell(2, 16, 0, 1000), 26: Cell(1, 1, 0, 32),
    27: Cell(1, 1, 0, 32), 28: Cell(2, 500, 0, 511), 30: Cell(1, 1, 1, 100), 31: Cell(2, 0, 0, 4095),
    33: Cell(1, 0, 0, 3), 34: Cell(1, 20, 0, 254), 35: Cell(1, 200, 0, 254), 36: Cell(1, 80, 0, 254),
    37: Cell(1, 10, 0, 254), 38: Cell(1, 200, 0, 254), 39: Cell(1, 10, 0, 254), 40: Cell(1, 0, 0, 128),
    41: Cell(1, 0, 0, 254), 42: Cell(2, 0, 0, 65535), 44: Cell(2, 0, 0, 65535), 46: Cell(2, 0, 0, 65535),
    48: Cell(2, 1000, 0, 1000), 50: Cell(2, 0), 52: Cell(2, 0), 54: Cell(1, 0), 55: Cell(1, 1, 0, 1),
    56: Cell(2, CENTRE), 58: Cell(2, 0), 60: Cell(2, 0), 62: Cell(1, 120), 63: Cell(1, 30), 64: Cell(1, 0),
    65: Cell(1, 0), 66: Cell(1, 0), 67: Cell(2, 0), 69: Cell(2, 0),
}  # fmt: skip


class EmulatedFeetech(EmulatedServo):
    """An STS3215, the variant for 12 V."""

    TABLE = TABLE
    AT = Places(
        number=5, delay=7, level=8, max_torque=16, torque=40, goal=42, speed=46, limit=48, position=56, volts=62,
        heat=63, waiting=64,
    )  # fmt: skip
    ROM_END = 40
    MODELS: ClassVar[Mapping[int, Mapping[int, int]]] = {777: {}}
    TURN_COUNTS, SPEED_RPM, FULL_RPM = TURN, 60 / TURN, 45.0
    BROWN_OUT_V = 3.8
    LEVELS: ClassVar[Mapping[int, int]] = {PING: 0, READ: 0, WRITE: 1}

    def __init__(self, number: int, model: int = 777, overload_s: float = 2.0) -> None:
        self._shaft = CENTRE
        """With all its turns. What it measures is less by the offset, and within one turn."""
        super().__init__(number, model, overload_s)
        self.put(35, min(round(overload_s * 100), 254))
        self.stand(CENTRE)
        self._saved = bytes(self._cells[: self.ROM_END])

    def power_up(self) -> None:
        """Registers that were written while the lock was on have their former values again."""
        shaft = self._shaft
        self._cells[: self.ROM_END] = self._saved
        super().power_up()
        self.stand((shaft - self._offset) % TURN)

    def be_wheel(self) -> None:
        self.put(33, WHEEL)
        self._saved = bytes(self._cells[: self.ROM_END])

    def stand(self, position: int) -> None:
        self._shaft = position + self._offset
        super().stand(position)

    @property
    def shaft(self) -> int:
        return self._shaft

    @property
    def baud(self) -> int:
        return BAUDS[self.get(6)]

    @property
    def _offset(self) -> int:
        return _value(self.get(31), 11)

    @property
    def motor(self) -> Motor:
        error, unload = self.error, self.get(19)
        limit = self.get(48) / 1000
        if error & unload & OVERLOAD:
            limit = min(limit, self.get(34) / 100)
        speed = _value(self.get(46), 15)
        low, high = self.get(9), self.get(11)
        goal = _value(self.get(42), 15)
        goal = self._offset + (min(max(goal, low), high) if low < high else goal)
        is_wheel = self.get(33) == WHEEL
        if is_wheel:
            goal = self._shaft + (round(copysign(TURN, speed)) if speed else 0)
        on = self.get(40) == 1 and self.powered and not error & unload & (OVERHEATING | CURRENT)
        return Motor(
            on,
            goal,
            abs(speed),
            limit,
            slope=FULL_PUSH,
            punch=self.get(24) / 1000,
            endless=speed if is_wheel else None,
            acceleration=ACCELERATION_STEPS * self.get(41),
        )

    def sense(self, shaft: int, speed: int, load: float, now_ns: int) -> None:
        self._shaft = shaft
        self.put(56, (shaft - self._offset) % TURN)
        self.put(58, _code(speed, 15))
        self.put(60, _code(round(load * 1000), 10))
        self.put(66, int(speed != 0))
        if not self.get(40) or abs(load) * 100 < self.get(36):
            self._straining_ns = None
        elif self._straining_ns is None:
            self._straining_ns = now_ns
        elif now_ns - self._straining_ns > self.get(35) * NS // 100:
            self.trip(OVERLOAD)

    def trip(self, error: int) -> None:
        self._tripped |= error

    @property
    def error(self) -> int:
        error = self._tripped
        if not self.get(15) <= self.get(62) <= self.get(14):
            error |= VOLTAGE
        if self.get(63) > self.get(13):
            error |= OVERHEATING
        return error

    def obey(self, instruction: int, data: bytes, now_ns: int) -> tuple[int, bytes] | None:
        self.put(65, self.error)
        return super().obey(instruction, data, now_ns)

    def _refused(self, why: str) -> None:
        return None

    def _write(self, address: int, values: bytes, now_ns: int) -> int:
        at, end = address, address + len(values)
        while at < end:
            cell = TABLE.get(at)
            if cell is None or at + cell.size > end:
                break
            value = int.from_bytes(values[at - address : at - address + cell.size], "little")
            if cell.low <= value <= cell.high:
                self._take(at, value)
                self.acted.append((now_ns, at, value))
            at += cell.size
        return 0

    def _take(self, at: int, value: int) -> None:
        if at == 40 and value == CENTRE_HERE:
            offset = (self._shaft - CENTRE) % TURN
            self._keep(31, _code(offset if offset < CENTRE else offset - TURN, 11))
            self.stand(CENTRE)
            return
        if at == 40 and value == 0:
            self._tripped = 0
        if at < self.ROM_END:
            self._keep(at, value)
        else:
            self.put(at, value)
        if at == 42:
            self.put(40, 1)

    def _keep(self, at: int, value: int) -> None:
        """Write a register that keeps its value without power, if the lock is off."""
        self.put(at, value)
        if not self.get(55):
            self._saved = bytes(self._cells[: self.ROM_END])


def _code(value: int, bit: int) -> int:
    """Encode a sign, in this bit, and a magnitude in those below."""
    return min(abs(value), (1 << bit) - 1) | (1 << bit if value < 0 else 0)


def _value(code: int, bit: int) -> int:
    return -(code & ((1 << bit) - 1)) if code >> bit & 1 else code
