"""The control tables of AX and RX servos as data (ROBOTIS AX-12, RX-28 and RX-64 manuals: the same addresses)."""

from __future__ import annotations

from math import pi
from typing import NamedTuple


class Register(NamedTuple):
    """A register of the control table: little-endian; registers below address 24 keep their value without power."""

    address: int
    size: int
    writable: bool = True


REGISTERS: dict[str, Register] = {
    "model": Register(0, 2, writable=False),
    "firmware": Register(2, 1, writable=False),
    "id": Register(3, 1),
    "baud": Register(4, 1),
    "return_delay": Register(5, 1),
    "cw_limit": Register(6, 2),
    "ccw_limit": Register(8, 2),
    "temperature_limit": Register(11, 1),
    "low_voltage": Register(12, 1),
    "high_voltage": Register(13, 1),
    "max_torque": Register(14, 2),
    "status_return": Register(16, 1),
    "alarm_led": Register(17, 1),
    "shutdown": Register(18, 1),
    "torque_enable": Register(24, 1),
    "led": Register(25, 1),
    "cw_margin": Register(26, 1),
    "ccw_margin": Register(27, 1),
    "cw_slope": Register(28, 1),
    "ccw_slope": Register(29, 1),
    "goal_position": Register(30, 2),
    "moving_speed": Register(32, 2),
    "torque_limit": Register(34, 2),
    "present_position": Register(36, 2, writable=False),
    "present_speed": Register(38, 2, writable=False),
    "present_load": Register(40, 2, writable=False),
    "voltage": Register(42, 1, writable=False),
    "temperature": Register(43, 1, writable=False),
    "moving": Register(46, 1, writable=False),
    "lock": Register(47, 1),
    "punch": Register(48, 2),
}
MODELS = {12: "AX-12", 18: "AX-18", 300: "AX-12W", 10: "RX-10", 24: "RX-24F", 28: "RX-28", 64: "RX-64"}
"""Names by the value of register `model`."""

SPEED_RADPS = 0.111 * 2 * pi / 60
"""Unit of the speed registers."""
FASTEST = 1023
FULL_TORQUE = 1023
SLOPES = (2, 4, 8, 16, 32, 64, 128)
"""Values of the slope registers: distance from the goal, counts, below which the servo pushes with less than its
limit."""
SIGN = 1 << 10
"""Sign bit of speed and load: set is clockwise, towards smaller positions."""

ERRORS = {
    0x01: "voltage",
    0x02: "angle limit",
    0x04: "overheating",
    0x08: "range",
    0x10: "checksum",
    0x20: "overload",
    0x40: "instruction",
}
"""The bits of a status packet's error byte."""
VOLTAGE, ANGLE_LIMIT, OVERHEATING, RANGE, CHECKSUM, OVERLOAD, INSTRUCTION = ERRORS
REFUSALS = ANGLE_LIMIT | RANGE | CHECKSUM | INSTRUCTION
"""Errors with which a servo refuses an instruction."""
SHUTDOWNS = OVERHEATING | OVERLOAD
"""Errors after which a servo has let go. It holds again only after its torque limit is written."""


def slope_of(compliance_counts: float) -> int:
    """The slope nearest to `compliance_counts` by ratio; the steepest for 0."""
    return min(SLOPES, key=lambda slope: max(slope, compliance_counts) / min(slope, max(compliance_counts, 1.0)))


def baud_of(value: int) -> int:
    """The baud rate for a value of register `baud`."""
    return round(2_000_000 / (value + 1))


def signed(value: int) -> int:
    """Decode the value of a speed or load register."""
    return -(value & (SIGN - 1)) if value & SIGN else value & (SIGN - 1)


class ServoReading(NamedTuple):
    """Registers 36 to 43 of one servo, and the error byte that came with them."""

    position: int
    speed: int
    load: int
    voltage_v: float
    temperature_c: int
    error: int
    at_ns: int
    """CLOCK_MONOTONIC."""


FIRST, LENGTH = 36, 8
"""Address and length of the registers of a reading."""


def reading(data: bytes, error: int, at_ns: int) -> ServoReading | None:
    """Decode eight bytes; None when a servo cannot measure such values."""
    position = int.from_bytes(data[0:2], "little")
    speed, load = int.from_bytes(data[2:4], "little"), int.from_bytes(data[4:6], "little")
    if position > 1023 or speed > 2047 or load > 2047:
        return None
    return ServoReading(position, signed(speed), signed(load), data[6] / 10, data[7], error, at_ns)


def errors_in(bits: int) -> tuple[str, ...]:
    return tuple(name for bit, name in ERRORS.items() if bits & bit)
