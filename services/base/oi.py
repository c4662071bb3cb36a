"""The Create's Open Interface as bytes: commands, sensor packets, stream frames. Pure; needs only the standard library.

Source: iRobot Create Open Interface (OI) manual. Multi-byte values are big-endian, speeds mm/s, angles degrees
counter-clockwise.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Literal, NamedTuple

BAUD = 57_600
MAX_SPEED_MMPS = 500
MAX_FRAME = 86
"""Largest stream frame, bytes: it fits into 15 ms, the period of the frames, at 57600 baud."""

START, SAFE, FULL, DEMO, DRIVE, DRIVE_DIRECT, STREAM, QUERY = 128, 131, 132, 136, 137, 145, 148, 149
OPCODES = range(128, 159)
OVERRUN = 52
"""This many drive commands are more bytes than any other command waits for."""
Mode = Literal["off", "passive", "safe", "full"]
MODES: tuple[Mode, ...] = ("off", "passive", "safe", "full")
HEADER = 19


class Packet(NamedTuple):
    """One sensor packet: its name, its size in bytes, and its range of values."""

    name: str
    size: int
    low: int
    high: int

    @property
    def signed(self) -> bool:
        return self.low < 0


BUMPS, CLIFF_LEFT, CLIFF_FRONT_LEFT, CLIFF_FRONT_RIGHT, CLIFF_RIGHT = 7, 9, 10, 11, 12
VIRTUAL_WALL, OVERCURRENTS, BUTTONS, DISTANCE, ANGLE, CHARGING, VOLTAGE, CURRENT, TEMPERATURE = (
    13,
    14,
    18,
    19,
    20,
    21,
    22,
    23,
    24,
)
CHARGE, CAPACITY, CLIFF_FRONT_LEFT_SIGNAL, CHARGERS, MODE, RIGHT_SPEED, LEFT_SPEED = 25, 26, 29, 34, 35, 41, 42
CLIFFS = (CLIFF_LEFT, CLIFF_FRONT_LEFT, CLIFF_FRONT_RIGHT, CLIFF_RIGHT)

PACKETS: dict[int, Packet] = {
    BUMPS: Packet("bumps and wheel drops", 1, 0, 31),
    CLIFF_LEFT: Packet("cliff left", 1, 0, 1),
    CLIFF_FRONT_LEFT: Packet("cliff front left", 1, 0, 1),
    CLIFF_FRONT_RIGHT: Packet("cliff front right", 1, 0, 1),
    CLIFF_RIGHT: Packet("cliff right", 1, 0, 1),
    VIRTUAL_WALL: Packet("virtual wall", 1, 0, 1),
    OVERCURRENTS: Packet("low side driver and wheel overcurrents", 1, 0, 31),
    BUTTONS: Packet("buttons", 1, 0, 15),
    DISTANCE: Packet("distance", 2, -32768, 32767),
    ANGLE: Packet("angle", 2, -32768, 32767),
    CHARGING: Packet("charging state", 1, 0, 5),
    VOLTAGE: Packet("voltage", 2, 0, 65535),
    CURRENT: Packet("current", 2, -32768, 32767),
    TEMPERATURE: Packet("battery temperature", 1, -128, 127),
    CHARGE: Packet("battery charge", 2, 0, 65535),
    CAPACITY: Packet("battery capacity", 2, 0, 65535),
    CLIFF_FRONT_LEFT_SIGNAL: Packet("cliff front left signal", 2, 0, 4095),
    CHARGERS: Packet("charging sources available", 1, 0, 3),
    MODE: Packet("OI mode", 1, 0, 3),
    RIGHT_SPEED: Packet("requested right velocity", 2, -500, 500),
    LEFT_SPEED: Packet("requested left velocity", 2, -500, 500),
}
"""The packets that this driver requests and two of the manual's examples, with the ranges from the manual."""

BUMP_RIGHT, BUMP_LEFT, WHEEL_DROPS = 0x01, 0x02, 0x1C
WHEEL_OVERCURRENTS = 0x18
PLAY, ADVANCE = 0x01, 0x04
CHARGES = (1, 2, 3)
"""Charging states in which current flows: reconditioning, full, trickle."""

Readings = dict[int, int]
"""Values by packet number."""


# --- commands --------------------------------------------------------------------------------------


def start() -> bytes:
    return bytes([START])


def enter(mode: str) -> bytes:
    """Safe or full mode."""
    return bytes([{"safe": SAFE, "full": FULL}[mode]])


def drive_direct(left_mmps: int, right_mmps: int) -> bytes:
    """Drive the wheels at these speeds. On the wire the right one comes first."""
    return bytes([DRIVE_DIRECT]) + _word(_clip(right_mmps)) + _word(_clip(left_mmps))


def drive(speed_mmps: int, radius_mm: int) -> bytes:
    """Drive an arc. The radius is positive to the left; -32768 is straight, 1 and -1 turn on the spot."""
    return bytes([DRIVE]) + _word(_clip(speed_mmps)) + _word(radius_mm)


def stream(packets: Sequence[int]) -> bytes:
    """Make the Create send these packets every 15 ms, instead of earlier ones. Raises ValueError when they do not
    fit."""
    if 3 + length(packets) > MAX_FRAME:
        raise ValueError(f"a stream frame of {len(packets)} packets does not fit into 15 ms")
    return bytes([STREAM, len(packets), *packets])


def query(packets: Sequence[int]) -> bytes:
    """Make the Create send these packets once, without numbers, frame and checksum."""
    return bytes([QUERY, len(packets), *packets])


def abort_demo() -> bytes:
    """End a built-in demo, if one runs."""
    return bytes([DEMO, 255])


def halt() -> bytes:
    """Stop a Create in any state. It is in passive mode afterwards.

    A garbled byte may have become a command that waits for up to 255 data bytes (a script, a list of packets) and
    swallows the next commands, or one that starts a demo, which drives by itself and ignores speeds."""
    return drive_direct(0, 0) * OVERRUN + abort_demo() + start()


def harmless(speed_mmps: int) -> int:
    """The nearest speed whose bytes are not opcodes.

    Commands have no checksum. When a byte is lost, the rest is read shifted by one, and a speed's low byte may be taken
    for an opcode: 135 drives off by itself, 155 makes the Create deaf for seconds, 129 changes the baud rate. Speeds
    that avoid these bytes differ by at most 16 mm/s, and after a lost byte the next command is read correctly.
    """
    speed_mmps = _clip(speed_mmps)
    low = speed_mmps & 0xFF
    if low not in OPCODES:
        return speed_mmps
    down, up = low - OPCODES.start + 1, OPCODES.stop - low
    return speed_mmps - down if down <= up else speed_mmps + up


def _word(value: int) -> bytes:
    return value.to_bytes(2, "big", signed=True)


def _clip(speed_mmps: int) -> int:
    return min(max(speed_mmps, -MAX_SPEED_MMPS), MAX_SPEED_MMPS)


# --- stream frames ---------------------------------------------------------------------------------


class StreamParser:
    """Finds frames in a stream of bytes: `[19][N][id data ...][checksum]`, whose sum is 0 modulo 256.

    A frame is accepted only when its sum is right, its packets are one of the requested lists, and each value is in the
    manual's range. Otherwise one byte is skipped and the search goes on behind it.
    """

    def __init__(self, lists: Collection[Sequence[int]]) -> None:
        self.skipped = 0
        """Bytes skipped so far."""
        self._lists = {tuple(packets) for packets in lists}
        self._lengths = {length(packets) for packets in self._lists}
        self._bytes = bytearray()

    def feed(self, data: bytes) -> list[Readings]:
        """Parse more bytes; returns the readings of the frames that they complete."""
        self._bytes += data
        frames = []
        at = 0
        while True:
            found = self._bytes.find(HEADER, at)
            self.skipped += (len(self._bytes) if found < 0 else found) - at
            at = len(self._bytes) if found < 0 else found
            left = len(self._bytes) - at
            if left < 2:
                break
            size = self._bytes[at + 1]
            if size in self._lengths:
                if left < size + 3:
                    break
                frame = self._bytes[at : at + size + 3]
                readings = _decode(frame[2:-1]) if sum(frame) % 256 == 0 else None
                if readings is not None and tuple(readings) in self._lists:
                    frames.append(readings)
                    at += size + 3
                    continue
            at += 1
            self.skipped += 1
        del self._bytes[:at]
        return frames

    def reset(self) -> None:
        """Drop an incomplete frame."""
        self.skipped += len(self._bytes)
        self._bytes.clear()


def answer(data: bytes, packets: Sequence[int]) -> Readings | None:
    """Parse the answer to a `query`; None when it is too short or a value is out of range. It has no checksum, so
    nothing must be controlled by it."""
    payload = bytearray()
    at = 0
    for packet in packets:
        size = PACKETS[packet].size
        payload += bytes([packet]) + data[at : at + size]
        at += size
    return _decode(payload) if at == len(data) else None


def length(packets: Sequence[int]) -> int:
    """Length of a stream frame's payload with these packets, bytes."""
    return sum(1 + PACKETS[packet].size for packet in packets)


def _decode(payload: bytearray) -> Readings | None:
    """Values by packet number, in order; None when a number is unknown or repeated, or a value is out of range."""
    readings: Readings = {}
    at = 0
    while at < len(payload):
        packet = PACKETS.get(payload[at])
        if packet is None or payload[at] in readings or at + 1 + packet.size > len(payload):
            return None
        value = int.from_bytes(payload[at + 1 : at + 1 + packet.size], "big", signed=packet.signed)
        if not packet.low <= value <= packet.high:
            return None
        readings[payload[at]] = value
        at += 1 + packet.size
    return readings
