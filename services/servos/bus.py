"""A serial line with servos of one family on it, through the Dynamixel SDK. It blocks: call it from a thread.

The SDK writes the instructions. `CheckedPort` replaces its reading: only valid answers of the asked servo reach it. A
status packet is `FF FF ID LENGTH ERROR data CHECKSUM` with LENGTH = bytes of data + 2 and CHECKSUM = inverted sum from
ID on (ROBOTIS AX-12 manual, Dynamixel Protocol 1.0; Feetech's protocol manual: the same packets and instructions).

So one SDK serves both families. Feetech's own, `ftservo-python-sdk` (MIT, maintained by the maker) and its older copy
`feetech-servo-sdk`, write the same bytes and have the port that `CheckedPort` is there to replace: it polls without
pause and goes by the wall clock. Both install one module of the same name.
"""

from __future__ import annotations

import errno
import select
import termios
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import NamedTuple, TypeVar

import serial
from dynamixel_sdk.port_handler import PortHandler
from dynamixel_sdk.protocol1_packet_handler import Protocol1PacketHandler
from dynamixel_sdk.robotis_def import COMM_SUCCESS

from cocoro.errors import CocoroError
from services.servos.dynamixel import DYNAMIXEL
from services.servos.family import READING_LENGTH, ServoFamily, ServoReading

HEADER = b"\xff\xff"
BROADCAST = 254
READ = 2


class Status(NamedTuple):
    """A status packet."""

    packet: bytes
    error: int
    data: bytes


def find_status(stream: bytes, number: int, length: int, refusals: int) -> Status | None:
    """Find the answer of servo `number` to a request for `length` bytes; None when there is none yet.

    A packet is valid when its number, length and checksum are right. When data were requested, a packet without data is
    valid only if its error has one of the bits `refusals`: the servo refuses. Everything else is skipped byte by byte,
    so that a broken packet cannot hide a good one.
    """
    at = stream.find(HEADER)
    while at >= 0:
        for size in (length, 0):
            packet = stream[at : at + size + 6]
            if len(packet) < size + 6 or packet[2] != number or packet[3] != size + 2 or packet[4] & 0x80:
                continue
            if ~sum(packet[2:-1]) & 0xFF != packet[-1]:
                continue
            if size == length or packet[4] & refusals:
                return Status(packet, packet[4], packet[5:-1])
        at = stream.find(HEADER, at + 1)
    return None


def asked(instruction: bytes) -> tuple[int, int] | None:
    """The servo that an instruction packet addresses, and the number of bytes that it requests; None when no servo
    answers it."""
    number = instruction[2]
    if number == BROADCAST:
        return None
    return number, instruction[6] if instruction[4] == READ else 0


class CheckedPort(PortHandler):  # type: ignore[misc] # the SDK has no types
    """A port for the SDK that sleeps until bytes arrive, goes by the monotonic clock, and returns only a complete and
    valid answer of the requested length from the requested servo.

    The SDK's own port polls without pause, goes by the wall clock, and accepts whatever looks like a packet.
    """

    is_open: bool

    def __init__(self, path: str, baud: int, timeout_s: float) -> None:
        super().__init__(path)
        self.baudrate = baud
        self.timeout_s = timeout_s
        self.refusals = 0
        """The error bits with which a servo refuses; see `find_status`."""
        self.strays = 0
        """Count of bytes that were not part of an answer."""
        self._stream = bytearray()
        self._ready = b""
        self._asked: tuple[int, int] | None = None
        self._deadline_s = 0.0

    def setupPort(self, cflag_baud: int) -> bool:  # noqa: N802 # the SDK's name
        if self.is_open:
            self.closePort()
        self.ser = serial.Serial(self.port_name, self.baudrate, timeout=0, write_timeout=0.1, exclusive=True)
        self.is_open = True
        self.clearPort()
        return True

    def clearPort(self) -> None:  # noqa: N802
        try:
            termios.tcflush(self.ser.fd, termios.TCIFLUSH)
        except termios.error as error:  # not an OSError
            raise OSError(*error.args) from error
        self.strays += len(self._stream)
        self._stream.clear()
        self._ready = b""

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        data = bytes(packet)
        self._asked = asked(data)
        written: int = self.ser.write(data)
        return written

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Read bytes of the expected answer. Waits for it; returns none after the time limit."""
        if not self._ready and self._asked is not None:
            self._await(*self._asked)
        data, self._ready = self._ready[:length], self._ready[length:]
        return data

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        self._deadline_s = time.monotonic() + self.timeout_s

    def setPacketTimeoutMillis(self, msec: float) -> None:  # noqa: N802
        self._deadline_s = time.monotonic() + msec / 1000.0

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return time.monotonic() >= self._deadline_s

    def _await(self, number: int, length: int) -> None:
        fd = self.ser.fd
        while (left_s := self._deadline_s - time.monotonic()) > 0:
            if not select.select([fd], [], [], left_s)[0]:
                return
            data = self.ser.read(4096)
            if not data:
                raise serial.SerialException("the adapter is gone")
            self._stream += data
            found: Status | None = find_status(bytes(self._stream), number, length, self.refusals)
            if found is not None:
                self._ready = found.packet
                self.strays += len(self._stream) - len(found.packet)
                self._stream.clear()
                return


REPLY_S = 0.015
"""Time limit for an answer: ten times what a servo and an FTDI adapter with 1 ms latency take."""

SENTENCES = {
    errno.ENOENT: "there is no such port: is the adapter plugged in?",
    errno.EACCES: "no permission: add the user to the group dialout, and log in again",
    errno.EAGAIN: "another program has it open",
    errno.EIO: "the adapter does not answer: is it plugged in?",
}


Answer = TypeVar("Answer")


class SilentError(CocoroError):
    """A servo does not answer."""

    def __init__(self, number: int) -> None:
        super().__init__(f"servo {number} does not answer")
        self.number = number


class RefusedWriteError(CocoroError):
    """A servo answers that it did not carry out an instruction."""


class PortError(CocoroError):
    """The line failed: no such port, no permission, or the adapter was unplugged."""


class ServoBus:
    """A context manager. Every method raises PortError when the line fails; the bus is unusable afterwards."""

    def __init__(
        self,
        path: str,
        baud: int,
        timeout_s: float = REPLY_S,
        family: ServoFamily = DYNAMIXEL,
        tries: int = 1,
        port: CheckedPort | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`tries`: how often a servo that does not answer is asked. A service asks once, since its next period comes
        soon; a tool asks again, since one lost packet shall not end what a person has begun. `port` and `clock_ns`
        replace the serial port at `path` and the clock of readings."""
        self.path = path
        self._tries = tries
        self._clock_ns = clock_ns
        self._sdk = Protocol1PacketHandler()
        self._port = port or CheckedPort(path, baud, timeout_s)
        self.family = family
        try:
            self._port.openPort()
        except (OSError, ValueError, termios.error) as error:
            raise PortError(f"{path}: {_sentence(error)}") from error

    def __enter__(self) -> ServoBus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        with suppress(OSError):
            self._port.closePort()

    @property
    def family(self) -> ServoFamily:
        """Whose registers it reads and writes. A tool that meets servos of any family changes it."""
        return self._family

    @family.setter
    def family(self, family: ServoFamily) -> None:
        self._family = family
        self._port.refusals = family.refusals

    @property
    def strays(self) -> int:
        """Count of received bytes that were not part of an answer: noise, and damaged or late packets."""
        return self._port.strays

    def ping(self, number: int) -> int | None:
        """The model number of the servo with this ID; None when no servo answers."""
        try:
            return self.read(number, "model")
        except SilentError:
            return None

    def read(self, number: int, register: str) -> int:
        """Read a register. Raises SilentError or RefusedWriteError."""
        row = self.family.registers[register]
        data, error = self.read_block(number, row.address, row.size)
        if error & self.family.refusals:
            raise RefusedWriteError(f"servo {number} refuses to read its {register}: {self._refusals_in(error)}")
        return int.from_bytes(data, "little")

    def read_block(self, number: int, address: int, length: int) -> tuple[bytes, int]:
        """Read the bytes of consecutive registers, and the error byte. Raises SilentError."""
        return self._answered(lambda: self._block(number, address, length))

    def _block(self, number: int, address: int, length: int) -> tuple[bytes, int]:
        try:
            data, result, error = self._sdk.readTxRx(self._port, number, address, length)
        except (OSError, ValueError) as fault:
            raise PortError(f"{self.path}: {_sentence(fault)}") from fault
        if result != COMM_SUCCESS or (len(data) < length and not error & self.family.refusals):
            raise SilentError(number)
        return bytes(data), error

    def reading(self, number: int) -> ServoReading:
        """Read what the servo measures now. Raises SilentError."""
        return self._answered(lambda: self._reading(number))

    def _reading(self, number: int) -> ServoReading:
        data, error = self._block(number, self.family.registers["present_position"].address, READING_LENGTH)
        found = self.family.reading(data, error, self._clock_ns()) if len(data) == READING_LENGTH else None
        if found is None:
            raise SilentError(number)
        return found

    def write(self, number: int, register: str, value: int) -> int:
        """Write a register; returns the error byte. Raises SilentError when it is not confirmed, RefusedWriteError when
        it is refused, ValueError for a read-only register. What must keep its value without power is written by
        `keep`."""
        row = self.family.registers[register]
        if not row.writable:
            raise ValueError(f"register {register} is read-only")
        return self._answered(lambda: self._write(number, register, value))

    def _write(self, number: int, register: str, value: int) -> int:
        row = self.family.registers[register]
        try:
            result, error = self._sdk.writeTxRx(
                self._port, number, row.address, row.size, list(value.to_bytes(row.size, "little"))
            )
        except (OSError, ValueError) as fault:
            raise PortError(f"{self.path}: {_sentence(fault)}") from fault
        if result != COMM_SUCCESS:
            raise SilentError(number)
        if error & self.family.refusals:
            raise RefusedWriteError(f"servo {number} refuses {value} for its {register}: {self._refusals_in(error)}")
        return int(error)

    def keep(self, number: int, register: str, value: int) -> None:
        """Write a register so that it keeps its value without power, and read it. Raises SilentError, and
        RefusedWriteError when it has another value."""
        lock = self.family.lock
        if lock:
            self.write(number, lock, 0)
        with suppress(SilentError):  # it may answer by its new ID already
            self.write(number, register, value)
        if register == "id" and self.ping(value) is not None:
            number = value
        if lock:
            self.write(number, lock, 1)
        if self.family.registers[register].kept and self.read(number, register) != value:
            raise RefusedWriteError(f"servo {number} does not take {value} for its {register}")

    def is_wheel(self, number: int) -> bool:
        """Whether a servo turns endlessly at its speed, instead of going to its goal. Raises SilentError."""
        address, length = self.family.block(self.family.modes[0], self.family.modes[-1])
        data, _ = self.read_block(number, address, length)
        if len(data) < length:
            raise SilentError(number)
        return self.family.is_wheel(data)

    def go(self, orders: Mapping[int, tuple[int, int]]) -> None:
        """Write goal position and moving speed (counts) of several servos by one sync write, which is not answered."""
        if not orders:
            return
        address, length = self.family.block(self.family.orders[0], self.family.orders[-1])
        values = {number: self.family.order(goal, speed) for number, (goal, speed) in orders.items()}
        self._write_all(address, length, values)

    def spin(self, speeds: Mapping[int, int]) -> None:
        """Write the speeds (counts, with their signs) of several wheels by one sync write, which is not answered."""
        row = self.family.registers["moving_speed"]
        self._write_all(row.address, row.size, {number: self.family.spin(speed) for number, speed in speeds.items()})

    def _write_all(self, address: int, length: int, values: Mapping[int, bytes]) -> None:
        data = [byte for number, value in values.items() for byte in (number, *value)]
        try:
            self._sdk.syncWriteTxOnly(self._port, address, length, data, len(data))
        except OSError as fault:
            raise PortError(f"{self.path}: {_sentence(fault)}") from fault

    def _answered(self, ask: Callable[[], Answer]) -> Answer:
        for _ in range(self._tries - 1):
            with suppress(SilentError):
                return ask()
        return ask()

    def _refusals_in(self, error: int) -> str:
        return ", ".join(self.family.errors_in(error & self.family.refusals))


def _sentence(error: Exception) -> str:
    return SENTENCES.get(getattr(error, "errno", None) or 0, str(error))
