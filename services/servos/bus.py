"""One serial line with servos on it, by the Dynamixel SDK. It blocks: call it from a thread."""

from __future__ import annotations

import errno
import termios
import time
from collections.abc import Mapping
from contextlib import suppress

from dynamixel_sdk.protocol1_packet_handler import Protocol1PacketHandler
from dynamixel_sdk.robotis_def import COMM_SUCCESS

from cocoro.errors import CocoroError
from services.servos import table
from services.servos.port import CheckedPort
from services.servos.table import REFUSALS, REGISTERS, Reading

REPLY_S = 0.015
"""So long an answer may take: what a servo and an FTDI adapter at 1 ms take, ten times over."""

SENTENCES = {
    errno.ENOENT: "there is no such port: is the adapter plugged in?",
    errno.EACCES: "no permission: add the user to the group dialout, and log in anew",
    errno.EAGAIN: "another program has it open",
    errno.EIO: "the adapter does not answer: is it plugged in?",
}


class SilentError(CocoroError):
    """A servo does not answer."""

    def __init__(self, number: int) -> None:
        super().__init__(f"servo {number} does not answer")
        self.number = number


class RefusedWriteError(CocoroError):
    """A servo answers that it did not do what it was asked."""


class PortError(CocoroError):
    """The line itself: no such port, no permission, the adapter was pulled."""


class Bus:
    """Use it with `with`. Raises PortError whenever the line fails; then it is of no use any more."""

    def __init__(self, path: str, baud: int, timeout_s: float = REPLY_S) -> None:
        self.path = path
        self._sdk = Protocol1PacketHandler()
        self._port = CheckedPort(path, baud, timeout_s)
        try:
            self._port.openPort()
        except (OSError, ValueError, termios.error) as error:
            raise PortError(f"{path}: {_plain(error)}") from error

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        with suppress(OSError):
            self._port.closePort()

    @property
    def strays(self) -> int:
        """Bytes so far that were no part of an answer: noise, damaged packets, late ones."""
        return self._port.strays

    def ping(self, number: int) -> int | None:
        """The model of the servo with this ID; None when there is none."""
        try:
            return self.read(number, "model")
        except SilentError:
            return None

    def read(self, number: int, register: str) -> int:
        """A register's value. Raises SilentError, RefusedWriteError."""
        row = REGISTERS[register]
        data, error = self.read_block(number, row.address, row.size)
        if error & REFUSALS:
            raise RefusedWriteError(f"servo {number} refuses to tell its {register}: {_words(error)}")
        return int.from_bytes(data, "little")

    def read_block(self, number: int, address: int, length: int) -> tuple[bytes, int]:
        """Registers as they stand, and the error byte. Raises SilentError."""
        try:
            data, result, error = self._sdk.readTxRx(self._port, number, address, length)
        except (OSError, ValueError) as fault:
            raise PortError(f"{self.path}: {_plain(fault)}") from fault
        if result != COMM_SUCCESS or (len(data) < length and not error & REFUSALS):
            raise SilentError(number)
        return bytes(data), error

    def reading(self, number: int) -> Reading:
        """What the servo measures now. Raises SilentError."""
        data, error = self.read_block(number, table.FIRST, table.LENGTH)
        found = table.reading(data, error, time.monotonic_ns()) if len(data) == table.LENGTH else None
        if found is None:
            raise SilentError(number)
        return found

    def write(self, number: int, register: str, value: int) -> int:
        """Set a register; the error byte. Raises SilentError when it is not confirmed, RefusedWriteError."""
        row = REGISTERS[register]
        if not row.writable:
            raise ValueError(f"{register} cannot be written")
        try:
            result, error = self._sdk.writeTxRx(
                self._port, number, row.address, row.size, list(value.to_bytes(row.size, "little"))
            )
        except (OSError, ValueError) as fault:
            raise PortError(f"{self.path}: {_plain(fault)}") from fault
        if result != COMM_SUCCESS:
            raise SilentError(number)
        if error & REFUSALS:
            raise RefusedWriteError(f"servo {number} refuses {value} for its {register}: {_words(error)}")
        return int(error)

    def go(self, orders: Mapping[int, tuple[int, int]]) -> None:
        """Goal position and moving speed of several servos at once, by one sync write, which nobody answers."""
        if not orders:
            return
        row = REGISTERS["goal_position"]
        data: list[int] = []
        for number, (goal, speed) in orders.items():
            data += [number, *goal.to_bytes(2, "little"), *speed.to_bytes(2, "little")]
        try:
            self._sdk.syncWriteTxOnly(self._port, row.address, 4, data, len(data))
        except OSError as fault:
            raise PortError(f"{self.path}: {_plain(fault)}") from fault


def _words(error: int) -> str:
    return ", ".join(table.errors_in(error & REFUSALS))


def _plain(error: Exception) -> str:
    return SENTENCES.get(getattr(error, "errno", None) or 0, str(error))
