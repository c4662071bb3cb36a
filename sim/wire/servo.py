"""A bus of emulated servos of any family: received bytes to sent bytes and motor commands. Pure.

Sources: ROBOTIS AX-12 manual (Dynamixel Protocol 1.0) and Feetech's protocol manual, whose packets are the same.
Where the manuals leave something open, the choice is the harder one for a driver: writing a goal enables the torque,
and two servos with one ID talk over each other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

BROADCAST = 254
PING, READ, WRITE, REG_WRITE, ACTION, RESET, SYNC_WRITE = 1, 2, 3, 4, 5, 6, 0x83
GAP_NS = 100_000_000
"""An instruction with a longer pause between two of its bytes is dropped."""


class Cell(NamedTuple):
    """One entry of the control table."""

    size: int
    start: int
    """Factory value, or value at power-up."""
    low: int = 0
    high: int = -1
    """Range of values that may be written; the cell is read-only when `high` is below `low`."""


class Places(NamedTuple):
    """The addresses of the cells that all families have."""

    number: int
    delay: int
    """Return delay, 2 us."""
    level: int
    """Status return level."""
    max_torque: int
    torque: int
    goal: int
    speed: int
    limit: int
    """Torque limit."""
    position: int
    volts: int
    """0.1 V."""
    heat: int
    waiting: int
    """Whether an instruction waits for the action."""


@dataclass
class Motor:
    """The motor command in a servo's registers."""

    on: bool
    goal: int
    """Place of the shaft, counts; beyond the range for a servo that turns endlessly."""
    speed: int
    """Counts of the family's unit of speed; 0 is full speed."""
    limit: float
    """Share of the stall torque."""
    slope: int
    """Distance from the goal, counts, below which it pushes with less than its limit."""
    punch: float
    endless: int | None = None
    """Speed, counts of the family's unit with a sign, of a servo that turns endlessly; None: it goes to its goal."""
    acceleration: int = 0
    """How fast that speed changes, the family's unit per second; 0: at once."""


class EmulatedServo(ABC):
    """One servo: its control table, and the conditions under which it shuts down. A subclass is a family."""

    TABLE: ClassVar[Mapping[int, Cell]]
    AT: ClassVar[Places]
    ROM_END: ClassVar[int]
    """Cells below this address keep their value without power."""
    MODELS: ClassVar[Mapping[int, Mapping[int, int]]]
    """Factory values that differ from the table's, by model number."""
    TURN_COUNTS: ClassVar[float]
    """Counts of position in a whole turn."""
    SPEED_RPM: ClassVar[float]
    """Unit of speeds."""
    FULL_RPM: ClassVar[float]
    """Its speed without load."""
    BROWN_OUT_V: ClassVar[float]
    """Below this voltage it is dead."""
    CHECKSUM: ClassVar[int] = 0
    """The error bit with which it answers a wrong checksum; 0: it does not answer."""
    LEVELS: ClassVar[Mapping[int, int]]
    """By instruction, the status return level from which on it is answered; others need the highest one."""

    def __init__(self, number: int, model: int, overload_s: float = 5.0) -> None:
        self.mute = False
        """Whether it is unplugged or broken."""
        self.overload_s = overload_s
        self.acted: list[tuple[int, int, int]] = []
        """(ns, address, value) of each register that was written: a log that tests read and clear."""
        self._size = max(address + cell.size for address, cell in self.TABLE.items())
        self._cells = bytearray(self._size)
        self._model = model
        self._registered: tuple[int, bytes] | None = None
        self._straining_ns: int | None = None
        self._tripped = 0
        self._factory()
        self.put(self.AT.number, number)
        self.put(self.AT.delay, 0)

    def _factory(self) -> None:
        for address, cell in self.TABLE.items():
            self.put(address, self.MODELS[self._model].get(address, cell.start))

    def power_up(self) -> None:
        """Restart it: volatile registers get their start values; the shaft does not move."""
        at, position = self.AT, self.get(self.AT.position)
        for address, cell in self.TABLE.items():
            if address >= self.ROM_END and address not in (at.volts, at.heat):
                self.put(address, cell.start)
        self.stand(position)
        self.put(at.limit, self.get(at.max_torque))
        self._tripped = 0
        self._straining_ns = None

    def be_wheel(self) -> None:
        """Set it up to turn endlessly, as its owner did before. Raises ValueError when no such setup is emulated."""
        raise ValueError(f"a servo of model {self._model} is not emulated as a wheel")

    def stand(self, position: int) -> None:
        """Set the position that it measures, counts; its goal is the same."""
        self.put(self.AT.position, position)
        self.put(self.AT.goal, position)

    # --- registers ----------------------------------------------------------------------------------

    def get(self, address: int) -> int:
        size = self.TABLE[address].size
        return int.from_bytes(self._cells[address : address + size], "little")

    def put(self, address: int, value: int) -> None:
        size = self.TABLE[address].size
        self._cells[address : address + size] = value.to_bytes(size, "little")

    @property
    def number(self) -> int:
        return self.get(self.AT.number)

    @property
    @abstractmethod
    def baud(self) -> int:
        """The baud rate that its register says."""

    @property
    def powered(self) -> bool:
        return self.get(self.AT.volts) / 10 >= self.BROWN_OUT_V

    @property
    def shaft(self) -> int:
        """Where its shaft is, counts."""
        return self.get(self.AT.position)

    @property
    @abstractmethod
    def motor(self) -> Motor:
        """What its motor does now."""

    @property
    def looks(self) -> dict[str, int]:
        """What an inspection shows of it."""
        at = self.AT
        places = {"position": at.position, "goal": at.goal, "torque": at.torque, "torque_limit": at.limit}
        return {name: self.get(place) for name, place in places.items()} | {"error": self.error}

    @abstractmethod
    def sense(self, shaft: int, speed: int, load: float, now_ns: int) -> None:
        """Set what its shaft does: place (counts), signed speed (the family's unit) and signed load (share of stall
        torque)."""

    @abstractmethod
    def trip(self, error: int) -> None:
        """Raise an error, and shut down if its registers say so."""

    @property
    @abstractmethod
    def error(self) -> int:
        """The error byte of its answers."""

    # --- instructions -------------------------------------------------------------------------------

    def obey(self, instruction: int, data: bytes, now_ns: int) -> tuple[int, bytes] | None:
        """Carry out an instruction; returns the error bits and the data of the answer, None when it does not answer."""
        error: int | None = 0
        answer = b""
        if instruction == PING:
            pass
        elif instruction == READ and len(data) == 2:
            if data[0] + data[1] > self._size or not data[1]:
                error = self._refused("range")
            else:
                answer = bytes(self._cells[data[0] : data[0] + data[1]])
        elif instruction == WRITE and len(data) >= 2:
            error = self._write(data[0], data[1:], now_ns)
        elif instruction == REG_WRITE and len(data) >= 2:
            self._registered = (data[0], data[1:])
            self.put(self.AT.waiting, 1)
        elif instruction == ACTION and self._registered is not None:
            address, values = self._registered
            self._registered = None
            self.put(self.AT.waiting, 0)
            error = self._write(address, values, now_ns)
        elif instruction == RESET:
            self._factory()
        else:
            error = self._refused("instruction")
        return None if error is None else (self.error | error, answer)

    @abstractmethod
    def _refused(self, why: str) -> int | None:
        """The error bits of an answer to what it refuses; None when it does not answer then."""

    @abstractmethod
    def _write(self, address: int, values: bytes, now_ns: int) -> int | None:
        """Write all values or none; returns the error bits, None when it does not answer."""


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
        answers: list[tuple[EmulatedServo, bytes]] = []
        for servo in (servo for servo in listening if servo.number == number):
            if not good:
                reply = (servo.error | servo.CHECKSUM, b"") if servo.CHECKSUM else None
            else:
                level = servo.get(servo.AT.level)
                reply = servo.obey(instruction, bytes(data), now_ns)
                if level < servo.LEVELS.get(instruction, max(servo.LEVELS.values())):
                    continue
            if reply is not None:
                answers.append((servo, _status(number, *reply)))
        self._answer(answers, baud, now_ns)

    def _answer(self, answers: list[tuple[EmulatedServo, bytes]], baud: int, now_ns: int) -> None:
        if answers:
            delay_ns = answers[0][0].get(answers[0][0].AT.delay) * 2000
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
