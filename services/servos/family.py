"""What differs between the families of servos, as data, and the decoding of their registers. Pure.

A family's control table is in a module of its own (`dynamixel`, `feetech`). Bus, line, motion, group and tools are
the same for all of them: they know registers by the names that the tables share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from cocoro.joints import Joint
from cocoro.servo_units import UNITS, Protocol, ServoUnits


class Register(NamedTuple):
    """A register of a control table: little-endian."""

    address: int
    size: int
    writable: bool = True
    kept: bool = False
    """Whether it keeps its value without power."""


class ServoReading(NamedTuple):
    """What one servo measures, and the error byte that came with it."""

    position: int
    speed: int
    load: int
    voltage_v: float
    temperature_c: int
    error: int
    at_ns: int
    """CLOCK_MONOTONIC."""


@dataclass(frozen=True)
class Signs:
    """Registers of a reading: the bit that says that the rest, the magnitude, is negative, and the greatest magnitude
    that a servo can measure."""

    position: tuple[int, int]
    speed: tuple[int, int]
    load: tuple[int, int]


@dataclass(frozen=True)
class ServoFamily:
    """A family of servos. Every family has the registers model, id, baud, return_delay, low_limit, high_limit,
    torque_enable, goal_position, moving_speed, torque_limit and present_position."""

    protocol: Protocol
    registers: Mapping[str, Register]
    models: Mapping[int, str]
    """Names by the value of register `model`."""
    orders: tuple[str, ...]
    """The consecutive registers that are written in each cycle. What is neither goal nor speed is 0."""
    settings: Callable[[Joint, float], dict[str, int]]
    """For a joint and the share of the stall torque that it may use, the registers that are written before its servo is
    enabled, among which is the torque limit. They are between torque_enable and torque_limit."""
    revival: Mapping[str, int]
    """What is written, besides the settings, before a servo that has shut down is enabled."""
    modes: tuple[str, ...]
    """The consecutive registers that tell a joint from a wheel. Together they are as long as no other answer."""
    is_wheel: Callable[[bytes], bool]
    """Whether a servo with these values turns endlessly instead of going to a goal."""
    signs: Signs
    wheel_settings: Mapping[str, int]
    """The registers that are written before the servo of a wheel is enabled."""
    volts: tuple[float, float]
    """The voltages of a supply that is well."""
    errors: Mapping[int, str]
    """The bits of a status packet's error byte."""
    refusals: int
    """Errors with which a servo refuses an instruction."""
    shutdowns: int
    """Errors after which a servo does not hold any more as it was told to."""
    lock: str = ""
    """The register that must be 0 while registers are written that shall keep their value; '' when there is none."""
    centring: tuple[str, int] | None = None
    """Register and value that make the present position the middle of the range; None when the zero is fixed."""

    @property
    def units(self) -> ServoUnits:
        return UNITS[self.protocol]

    def block(self, first: str, last: str) -> tuple[int, int]:
        """Address and length of the registers from `first` to `last`."""
        start, end = self.registers[first], self.registers[last]
        return start.address, end.address + end.size - start.address

    def order(self, goal: int, speed: int) -> bytes:
        """The values of `orders` for goal and speed, counts."""
        values = {"goal_position": goal, "moving_speed": speed}
        return b"".join(values.get(name, 0).to_bytes(self.registers[name].size, "little") for name in self.orders)

    def spin(self, speed: int) -> bytes:
        """The value of `moving_speed` for a wheel's speed, counts with a sign."""
        sign, _ = self.signs.speed
        return (min(abs(speed), sign - 1) | (sign if speed < 0 else 0)).to_bytes(2, "little")

    def reading(self, data: bytes, error: int, at_ns: int) -> ServoReading | None:
        """Decode the eight bytes from the present position on; None when a servo cannot measure such values."""
        values = []
        for at, (sign, top) in enumerate((self.signs.position, self.signs.speed, self.signs.load)):
            value = signed(int.from_bytes(data[2 * at : 2 * at + 2], "little"), sign)
            if abs(value) > top:
                return None
            values.append(value)
        return ServoReading(values[0], values[1], values[2], data[6] / 10, data[7], error, at_ns)

    def errors_in(self, bits: int) -> tuple[str, ...]:
        return tuple(name for bit, name in self.errors.items() if bits & bit)


READING_LENGTH = 8
"""Bytes from the present position to the temperature, in every family."""


def signed(value: int, sign: int) -> int:
    """Decode a sign and a magnitude: negative when the bit `sign`, such as 1 << 10, is set."""
    return -(value ^ sign) if value & sign else value


def kept(address: int, size: int, *, writable: bool = True) -> Register:
    """A register that keeps its value without power."""
    return Register(address, size, writable, kept=True)
