"""The firmware of an iRobot Create: received bytes to sent bytes and wheel speeds. Pure.

Source: iRobot Create Open Interface manual. Where it leaves something open, the choice is the harder one for a driver:
a lost byte shifts the rest, data bytes in the place of an opcode are opcodes, and counts below a unit are lost when
read.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import degrees
from struct import pack

from cocoro.clock import NS

OFF, PASSIVE, SAFE, FULL = range(4)
FRAME_NS = 15_000_000
RADIUS_MM = 165
WHEEL_BASE_MM = 258.0
BAUDS = (300, 600, 1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 115200)
"""Baud rates by the code that opcode 129 takes."""
FIXED = {
    128: 0, 129: 1, 130: 0, 131: 0, 132: 0, 134: 0, 135: 0, 136: 1, 137: 4, 138: 1, 139: 3, 141: 1, 142: 1, 143: 0,
    144: 3, 145: 4, 147: 1, 150: 1, 151: 1, 153: 0, 154: 0, 155: 1, 156: 2, 157: 2, 158: 1,
}  # fmt: skip
"""Number of data bytes of each opcode with a fixed number. Bytes that are no opcode are ignored."""
COUNTED = {140: (1, 2), 148: (0, 1), 149: (0, 1), 152: (0, 1)}
"""Opcodes with a variable number of data bytes: the index of the count among them, and the bytes per unit of it."""
GROUPS = {0: (7, 26), 1: (7, 16), 2: (17, 20), 3: (21, 26), 4: (27, 34), 5: (35, 42), 6: (7, 42)}
WORDS = {
    19: "h", 20: "h", 22: "H", 23: "h", 25: "H", 26: "H", 27: "H", 28: "H", 29: "H", 30: "H", 31: "H", 33: "H",
    39: "h", 40: "h", 41: "h", 42: "h",
}  # fmt: skip
"""Formats of the packets with two bytes; the others have one, unsigned except for packet 24."""
DEMO_SPEED_MMPS = 200
STRAIGHT = (-32768, 32767)


@dataclass
class CreateSensors:
    """Values of the Create's sensors. The plant and the tests set them."""

    bump_left: bool = False
    bump_right: bool = False
    drop_left: bool = False
    drop_right: bool = False
    drop_caster: bool = False
    cliffs: list[bool] = field(default_factory=lambda: [False] * 4)
    """Left, front left, front right, right."""
    wall: bool = False
    left_overcurrent: bool = False
    right_overcurrent: bool = False
    charger: bool = False
    buttons: int = 0
    charge_mah: int = 2300
    capacity_mah: int = 2702
    voltage_mv: int = 15_800
    current_ma: int = -300
    temperature_c: int = 25


class EmulatedCreate:
    """The device at the end of a `sim.wire.emulator.Line`. Times are CLOCK_MONOTONIC.

    The line calls `receive` and `advance`; the plant drives the wheels at `wheels_mmps` and calls `roll`.
    """

    def __init__(self, wheel_base_mm: float = WHEEL_BASE_MM) -> None:
        self.sensors = CreateSensors()
        self.powered = True
        self.wheels_mmps = (0, 0)
        """Left, right."""
        self.acted: list[tuple[int, tuple[int, int]]] = []
        """Time (ns) and wheel speeds of each change, newest last: a log that tests read and clear."""
        self._wheel_base_mm = wheel_base_mm
        self._now_ns = 0
        self._boot()

    def _boot(self) -> None:
        self.mode = OFF
        self.baud = 57600
        self._requested = {39: 0, 40: 0, 41: 0, 42: 0}
        self._input: deque[int] = deque()
        self._pending: list[int] = []
        self._stream: list[int] = []
        self._streaming = False
        self._out = bytearray()
        self._next_frame_ns = 0
        self._deaf: Callable[[], bool] | None = None
        self._distance_mm = self._turn_rad = 0.0
        self._total_mm = self._total_rad = 0.0
        self._turn_wheels(0, 0)

    # --- the outside world --------------------------------------------------------------------------

    def power_cycle(self) -> None:
        """Restart it: off mode, no streaming, factory baud rate."""
        self._boot()

    def roll(self, left_m: float, right_m: float) -> None:
        """Add the distances that the wheel encoders measured."""
        distance_mm = (left_m + right_m) * 500.0
        turn_rad = (right_m - left_m) * 1000.0 / self._wheel_base_mm
        self._distance_mm += distance_mm
        self._turn_rad += turn_rad
        self._total_mm += distance_mm
        self._total_rad += turn_rad

    def receive(self, data: bytes, baud: int, now_ns: int) -> None:
        """Take bytes that were sent at this baud rate."""
        self._now_ns = now_ns
        if self.powered and baud == self.baud:
            self._input.extend(data)
            self._work()

    def advance(self, baud: int, now_ns: int) -> bytes:
        """The bytes that a listener at this baud rate has received by now."""
        self._now_ns = now_ns
        if not self.powered:
            self._out.clear()
            return b""
        self._work()
        self._safety()
        if now_ns >= self._next_frame_ns:
            # It sends at its own pace; after a long pause of the calls it continues from now.
            self._next_frame_ns = max(self._next_frame_ns + FRAME_NS, now_ns - FRAME_NS)
            if self._streaming and self._stream:
                self._send_frame()
        out = bytes(self._out)
        self._out.clear()
        return out if baud == self.baud else b""

    @property
    def pending(self) -> bytes:
        """The received bytes of an incomplete command."""
        return bytes(self._pending)

    @property
    def deaf(self) -> bool:
        """Whether it waits for an event (opcodes 155 to 158), and ignores everything until then."""
        return self._deaf is not None

    # --- commands -----------------------------------------------------------------------------------

    def _work(self) -> None:
        """Execute the commands in the input, unless it is deaf."""
        if self._deaf is not None and not self._deaf():
            self._deaf = None
        while self._input and self._deaf is None:
            self._pending.append(self._input.popleft())
            opcode, *data = self._pending
            if opcode not in FIXED and opcode not in COUNTED:
                self._pending.clear()
            elif len(data) >= self._wanted(opcode, data):
                self._pending.clear()
                self._obey(opcode, data)

    @staticmethod
    def _wanted(opcode: int, data: list[int]) -> int:
        if opcode in FIXED:
            return FIXED[opcode]
        place, unit = COUNTED[opcode]
        return place + 1 + (unit * data[place] if len(data) > place else 0)

    def _obey(self, opcode: int, data: list[int]) -> None:
        if opcode == 128:
            self._enter(PASSIVE)
        if self.mode == OFF:
            return
        if opcode == 129 and data[0] < len(BAUDS):
            self.baud = BAUDS[data[0]]
        elif opcode in (130, 131):
            self._enter(SAFE)
        elif opcode == 132:
            self._enter(FULL)
        elif opcode in (134, 135) or (opcode == 136 and data[0] != 255):
            self._enter(PASSIVE)
            self._turn_wheels(DEMO_SPEED_MMPS, DEMO_SPEED_MMPS // 2)
        elif opcode == 136:
            self._enter(PASSIVE)
        elif opcode == 142:
            self._out += b"".join(self._value(packet) for packet in _expand(data))
        elif opcode == 148:
            self._stream, self._streaming = data[1:], True
        elif opcode == 149:
            self._out += b"".join(self._value(packet) for packet in _expand(data[1:]))
        elif opcode == 150:
            self._streaming = bool(data[0])
        elif self.mode in (SAFE, FULL):
            self._move(opcode, data)

    def _move(self, opcode: int, data: list[int]) -> None:
        """Execute a command that passive mode ignores."""
        if opcode == 145:
            right, left = _signed(data[0:2]), _signed(data[2:4])
            self._requested |= {41: _clip(right), 42: _clip(left)}
            self._turn_wheels(_clip(left), _clip(right))
        elif opcode == 137:
            self._drive(_clip(_signed(data[0:2])), _signed(data[2:4]))
        elif opcode == 155:
            until_ns = self._now_ns + data[0] * NS // 10
            self._deaf = lambda: self._now_ns < until_ns
        elif opcode == 156:
            goal_mm = self._total_mm + _signed(data)
            sign = 1 if goal_mm >= self._total_mm else -1
            self._deaf = lambda: sign * (goal_mm - self._total_mm) > 0
        elif opcode == 157:
            goal_deg = degrees(self._total_rad) + _signed(data)
            turn = 1 if goal_deg >= degrees(self._total_rad) else -1
            self._deaf = lambda: turn * (goal_deg - degrees(self._total_rad)) > 0
        elif opcode == 158:
            event = data[0] if data[0] < 128 else data[0] - 256
            self._deaf = lambda: self._event(abs(event)) != (event > 0)

    def _drive(self, speed: int, radius: int) -> None:
        self._requested |= {39: speed, 40: radius}
        if radius in STRAIGHT:
            self._turn_wheels(speed, speed)
        elif radius in (1, -1):
            self._turn_wheels(-speed * radius, speed * radius)
        elif radius:
            half = self._wheel_base_mm / 2
            self._turn_wheels(
                _clip(round(speed * (radius - half) / radius)), _clip(round(speed * (radius + half) / radius))
            )

    def _enter(self, mode: int) -> None:
        if mode == PASSIVE or self.mode == PASSIVE:  # a demo ends, and nothing moves in passive mode
            self._turn_wheels(0, 0)
        self.mode = mode

    def _turn_wheels(self, left: int, right: int) -> None:
        if (left, right) != self.wheels_mmps:
            self.wheels_mmps = (left, right)
            self.acted.append((self._now_ns, self.wheels_mmps))

    def _safety(self) -> None:
        """Leave safe mode at a cliff while driving forward (or backward in a tight turn), on a wheel drop, and at the
        charger."""
        sensors = self.sensors
        dropped = sensors.drop_left or sensors.drop_right or sensors.drop_caster
        if self.mode == SAFE and (dropped or sensors.charger or (any(sensors.cliffs) and self._towards_a_cliff())):
            self._enter(PASSIVE)

    def _towards_a_cliff(self) -> bool:
        left, right = self.wheels_mmps
        if left + right > 0:
            return True
        if left == right:
            return False
        radius_mm = self._wheel_base_mm / 2 * abs((left + right) / (right - left))
        return left + right < 0 and radius_mm < RADIUS_MM

    def _event(self, event: int) -> bool:
        sensors = self.sensors
        return {
            1: sensors.drop_left or sensors.drop_right or sensors.drop_caster,
            2: sensors.drop_caster,
            3: sensors.drop_left,
            4: sensors.drop_right,
            5: sensors.bump_left or sensors.bump_right,
            6: sensors.bump_left,
            7: sensors.bump_right,
            9: sensors.wall,
            10: any(sensors.cliffs),
            11: sensors.cliffs[0],
            12: sensors.cliffs[1],
            13: sensors.cliffs[2],
            14: sensors.cliffs[3],
            22: self.mode == PASSIVE,
        }.get(event, False)

    # --- sensors ------------------------------------------------------------------------------------

    def _send_frame(self) -> None:
        payload = b"".join(bytes([packet]) + self._value(packet) for packet in self._stream)
        frame = bytes([19, len(payload) & 0xFF]) + payload
        self._out += frame + bytes([-sum(frame) & 0xFF])

    def _value(self, packet: int) -> bytes:
        value = self._measure(packet)
        return pack(f">{WORDS.get(packet, 'b' if packet == 24 else 'B')}", value)

    def _measure(self, packet: int) -> int:
        sensors = self.sensors
        if packet == 19:
            distance, self._distance_mm = int(self._distance_mm), 0.0
            return min(max(distance, -32768), 32767)
        if packet == 20:
            turn, self._turn_rad = int(degrees(self._turn_rad)), 0.0
            return min(max(turn, -32768), 32767)
        if packet in self._requested:
            return self._requested[packet]
        if 9 <= packet <= 12:
            return int(sensors.cliffs[packet - 9])
        return {
            7: sensors.bump_right
            | sensors.bump_left << 1
            | sensors.drop_right << 2
            | sensors.drop_left << 3
            | sensors.drop_caster << 4,
            8: int(sensors.wall),
            14: sensors.right_overcurrent << 3 | sensors.left_overcurrent << 4,
            17: 255,
            18: sensors.buttons,
            21: 2 if sensors.charger else 0,
            22: sensors.voltage_mv,
            23: sensors.current_ma,
            24: sensors.temperature_c,
            25: sensors.charge_mah,
            26: sensors.capacity_mah,
            34: 2 if sensors.charger else 0,
            35: self.mode,
            38: len(self._stream),
        }.get(packet, 0)


def _expand(packets: list[int]) -> Iterator[int]:
    for packet in packets:
        first, last = GROUPS.get(packet, (packet, packet))
        yield from range(first, last + 1)


def _signed(data: list[int]) -> int:
    return int.from_bytes(bytes(data), "big", signed=True)


def _clip(speed: int) -> int:
    return min(max(speed, -500), 500)
