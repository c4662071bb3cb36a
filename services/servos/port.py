"""A serial port for the Dynamixel SDK that waits without spinning and lets only good answers through."""

from __future__ import annotations

import select
import termios
import time

import serial
from dynamixel_sdk.port_handler import PortHandler

from services.servos.packets import Status, asked, find_status


class CheckedPort(PortHandler):  # type: ignore[misc] # the SDK has no types
    """The SDK's own port polls without rest, by the wall clock, and its reader takes what looks like a packet.

    This one sleeps until bytes arrive, measures time by the monotonic clock, and hands on nothing but the whole,
    checked answer of the servo that was asked, of the length that was asked for.
    """

    is_open: bool

    def __init__(self, path: str, baud: int, timeout_s: float) -> None:
        super().__init__(path)
        self.baudrate = baud
        self.timeout_s = timeout_s
        self.strays = 0
        """Bytes that were no part of an answer."""
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
        except termios.error as error:  # which is no OSError
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
        """Bytes of the awaited answer; waits for it, and gives none when the time is over."""
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
            found: Status | None = find_status(bytes(self._stream), number, length)
            if found is not None:
                self._ready = found.packet
                self.strays += len(self._stream) - len(found.packet)
                self._stream.clear()
                return
