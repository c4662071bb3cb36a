"""A bus of Dynamixel AX-12 and RX-28 servos, Protocol 1.0: received bytes to sent bytes and motor commands. Pure.

Source: ROBOTIS AX-12 manual and the RX-28's e-manual (the same addresses). Where they leave something open, the choice
is the harder one for a driver: writing a goal enables the torque, and two servos with one ID talk over each other.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from cocoro.clock import NS

BROADCAST = 254
PING, READ, WRITE, REG_WRITE, ACTION, RESET, SYNC_WRITE = 1, 2, 3, 4, 5, 6, 0x83
VOLTAGE, ANGLE_LIMIT, OVERHEATING, RANGE, CHECKSUM, OVERLOAD, INSTRUCTION = (1 << bit for bit in range(7))
GAP_NS = 100_000_000
"""An instruction with a longer pause between two of its bytes is dropped."""
OVERLOAD_SHARE = 0.98
BROWN_OUT_V = 6.0


class Cell(NamedTuple):
    """One entry of the control table."""

    size: int
    start: int
    """Factory value, or value at power-up."""
    low: int = 0
    high: int = -1
    """Range of values that may be written; the cell is read-only when `high` is below `low`."""


TABLE: dict[int, Cell] = {
    0: Cell(2, 12), 2: Cell(1, 24), 3: Cell(1, 1, 0, 253), 4: Cell(1, 1, 0, 254), 5: Cell(1, 250, 0, 254),
    6: Cell(2, 0, 0, 1023), 8: Cell(2, 1023, 0, 1023), 11: Cell(1, 70, 0, 150), 12: Cell(1, 60, 50, 250),
    13: Cell(1, 140, 50, 250), 14: Cell(2, 1023, 0, 1023), 16: Cell(1, 2, 0, 2), 17: Cell(1, 36, 0, 127),
    18: Cell(1, 36, 0, 127), 24: Cell(1, 0, 0, 1), 25: Cell(1, 0, 0, 1), 26: Cell(1, 1, 0, 254),
    27: Cell(1, 1, 0, 254), 28: Cell(1, 32, 1, 254), 29: Cell(1, 32, 1, 254), 30: Cell(2, 512, 0, 1023),
    32: Cell(2, 0, 0, 1023), 34: Cell(2, 1023, 0, 1023), 36: Cell(2, 512), 38: Cell(2, 0), 40: Cell(2, 0),
    42: Cell(1, 120), 43: Cell(1, 30), 44: Cell(1, 0), 46: Cell(1, 0), 47: Cell(1, 0, 1, 1), 48: Cell(2, 32, 0, 1023),
}  # fmt: skip
SIZE = 50
ROM_END = 24
"""Cells below this address keep their value without power."""
MODELS = {12: {}, 28: {0: 28, 11: 80, 13: 240}}
"""Factory values that differ from an AX-12's, by model number."""


@dataclass
class Motor:
    """The motor command in a servo's registers."""

    on: bool
    goal: int
    speed: int
    """Counts of 0.111 rpm; 0 is full speed."""
    limit: float
    """Share of the stall torque."""
    slope: int
    """Distance from the goal, counts, below which it pushes with less than its limit."""
    punch: float


class EmulatedServo:
    """One servo: its control table, and the conditions under which it shuts down."""

    def __init__(self, number: int, model: int = 12, overload_s: float = 5.0) -> None:
        self.mute = False
        """Whether it is unplugged or broken."""
        self.overload_s = overload_s
        self.acted: list[tuple[int, int, int]] = []
        """(ns, address, value) of each register that was written: a log that tests read and clear."""
        self._cells = bytearray(SIZE)
        self._model = model
        self._registered: tuple[int, bytes] | None = None
        self._straining_ns: int | None = None
        self._tripped = 0
        self._factory()
        self.put(3, number)
        self.put(5, 0)

    def _factory(self) -> None:
        for address, cell in TABLE.items():
            self.put(address, MODELS[self._model].get(address, cell.start))

    def power_up(self) -> None:
        """Restart it: volatile registers get their start values; the shaft does not move."""
        position = self.get(36)
        for address, cell in TABLE.items():
            if address >= ROM_END and address not in (42, 43):
                self.put(address, cell.start)
        self.put(36, position)
        self.put(30, position)
        self.put(34, self.get(14))
        self._tripped = 0
        self._straining_ns = None

    # --- registers ----------------------------------------------------------------------------------

    def get(self, address: int) -> int:
        size = TABLE[address].size
        return int.from_bytes(self._cells[address : address + size], "little")

    def put(self, address: int, value: int) -> None:
        size = TABLE[address].size
        self._cells[address : address + size] = value.to_bytes(size, "little")

    @property
    def number(self) -> int:
        return self.get(3)

    @property
    def baud(self) -> int:
        return round(2_000_000 / (self.get(4) + 1))

    @property
    def powered(self) -> bool:
        return self.get(42) / 10 >= BROWN_OUT_V

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

    def sense(self, position: int, speed: int, load: float, now_ns: int) -> None:
        """Set what its shaft does: position (counts), signed speed (0.111 rpm) and signed load (share of stall
        torque)."""
        self.put(36, min(max(position, 0), 1023))
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
        """Raise an error, and shut down if register 18 says so."""
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

    # --- instructions -------------------------------------------------------------------------------

    def obey(self, instruction: int, data: bytes, now_ns: int) -> tuple[int, bytes]:
        """Carry out an instruction; returns the error bits and the data of the answer."""
        if self.error & OVERHEATING:
            self.trip(OVERHEATING)
        error, answer = 0, b""
        if instruction == PING:
            pass
        elif instruction == READ and len(data) == 2:
            if data[0] + data[1] > SIZE or not data[1]:
                error = RANGE
            else:
                answer = bytes(self._cells[data[0] : data[0] + data[1]])
        elif instruction == WRITE and len(data) >= 2:
            error = self._write(data[0], data[1:], now_ns)
        elif instruction == REG_WRITE and len(data) >= 2:
            self._registered = (data[0], data[1:])
            self.put(44, 1)
        elif instruction == ACTION and self._registered is not None:
            address, values = self._registered
            self._registered = None
            self.put(44, 0)
            error = self._write(address, values, now_ns)
        elif instruction == RESET:
            self._factory()
        else:
            error = INSTRUCTION
        return self.error | error, answer

    def _write(self, address: int, values: bytes, now_ns: int) -> int:
        """Write all values or none; returns the error bits."""
        changes: list[tuple[int, int]] = []
        end = address + len(values)
        at = address
        while at < end:
            cell = TABLE.get(at)
            if cell is None or at + cell.size > end:
                return RANGE
            value = int.from_bytes(values[at - address : at - address + cell.size], "little")
            if not cell.low <= value <= cell.high or (at < ROM_END and self.get(47)):
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


class EmulatedServoBus:
    """The servos on one line: the device at the end of a `sim.wire.emulator.Line`. Times are CLOCK_MONOTONIC."""

    def __init__(self, servos: Iterable[EmulatedServo]) -> None:
        self.servos = list(servos)
        self._in = bytearray()
        self._received_ns = 0
        self._out: list[tuple[int, int, bytes]] = []
        """(ns, baud rate, bytes) of answers."""

    def by_number(self, number: int) -> EmulatedServo:
        return next(servo for servo in self.servos if servo.number == number)

    def receive(self, data: bytes, baud: int, now_ns: int) -> None:
        """Take bytes that were sent at this baud rate."""
        if now_ns - self._received_ns > GAP_NS:
            self._in.clear()
        self._received_ns = now_ns
        self._in += data
        while (packet := self._packet()) is not None:
            self._dispatch(packet, baud, now_ns)

    def advance(self, baud: int, now_ns: int) -> bytes:
        """The bytes that a listener at this baud rate has received by now."""
        due = [answer for answer in self._out if answer[0] <= now_ns]
        self._out = [answer for answer in self._out if answer[0] > now_ns]
        return b"".join(data for _, at_baud, data in due if at_baud == baud)

    def _packet(self) -> bytes | None:
        """The next complete packet, from its ID to its checksum; None when there is none."""
        while True:
            start = self._in.find(b"\xff\xff")
            if start < 0:
                del self._in[: max(len(self._in) - 1, 0)]
                return None
            del self._in[:start]
            if len(self._in) > 2 and self._in[2] == 0xFF:
                del self._in[0]
                continue
            if len(self._in) < 4:
                return None
            if self._in[3] < 2:
                del self._in[:2]
                continue
            end = 4 + self._in[3]
            if len(self._in) < end:
                return None
            packet = bytes(self._in[2:end])
            del self._in[:end]
            return packet

    def _dispatch(self, packet: bytes, baud: int, now_ns: int) -> None:
        number, _, instruction, *data, checksum = packet
        good = ~sum(packet[:-1]) & 0xFF == checksum
        listening = [servo for servo in self.servos if servo.baud == baud and servo.powered and not servo.mute]
        if number == BROADCAST:
            if good:
                self._broadcast(listening, instruction, bytes(data), now_ns)
            return
        answers = []
        for servo in (servo for servo in listening if servo.number == number):
            if not good:
                error, answer = servo.error | CHECKSUM, b""
            else:
                level = servo.get(16)
                error, answer = servo.obey(instruction, bytes(data), now_ns)
                if instruction != PING and level < (1 if instruction == READ else 2):
                    continue
            answers.append((servo, _status(number, error, answer)))
        self._answer(answers, baud, now_ns)

    def _answer(self, answers: list[tuple[EmulatedServo, bytes]], baud: int, now_ns: int) -> None:
        if answers:
            delay_ns = answers[0][0].get(5) * 2000
            shortest = min(len(data) for _, data in answers)
            data = bytes(_all(data[at] for _, data in answers) for at in range(shortest))
            data += max((data for _, data in answers), key=len)[shortest:]
            self._out.append((now_ns + delay_ns, baud, data))

    def _broadcast(self, servos: list[EmulatedServo], instruction: int, data: bytes, now_ns: int) -> None:
        if instruction == SYNC_WRITE and len(data) >= 2:
            address, length = data[0], data[1]
            for at in range(2, len(data) - length, length + 1):
                for servo in servos:
                    if servo.number == data[at]:
                        servo.obey(WRITE, bytes([address]) + data[at + 1 : at + 1 + length], now_ns)
        elif instruction in (WRITE, REG_WRITE, ACTION):
            for servo in servos:
                servo.obey(instruction, data, now_ns)


def _all(values: Iterable[int]) -> int:
    """The byte on the line when several servos send at once."""
    value = 0xFF
    for one in values:
        value &= one
    return value


def _status(number: int, error: int, data: bytes) -> bytes:
    body = bytes([number, len(data) + 2, error]) + data
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def _signed(value: int) -> int:
    """Encode a speed or load: ten bits, and the sign in the eleventh."""
    return min(abs(value), 1023) | (1024 if value < 0 else 0)
