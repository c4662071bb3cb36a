"""An iRobot Create's firmware: bytes in, bytes out, wheels that were asked for. Pure.

Source: iRobot Create Open Interface manual. What it leaves open is decided so as to be hard on a driver: a lost byte
shifts what follows, data bytes in an opcode's place are opcodes, and counts below a unit are forgotten when read.
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
"""By the code that opcode 129 takes."""
FIXED = {
    128: 0, 129: 1, 130: 0, 131: 0, 132: 0, 134: 0, 135: 0, 136: 1, 137: 4, 138: 1, 139: 3, 141: 1, 142: 1, 143: 0,
    144: 3, 145: 4, 147: 1, 150: 1, 151: 1, 153: 0, 154: 0, 155: 1, 156: 2, 157: 2, 158: 1,
}  # fmt: skip
"""Data bytes of the opcodes that always have the same number of them; the other bytes are none and are ignored."""
COUNTED = {140: (1, 2), 148: (0, 1), 149: (0, 1), 152: (0, 1)}
"""Opcode: where the count stands among the data bytes, and how many bytes each unit of it has."""
GROUPS = {0: (7, 26), 1: (7, 16), 2: (17, 20), 3: (21, 26), 4: (27, 34), 5: (35, 42), 6: (7, 42)}
WORDS = {
    19: "h", 20: "h", 22: "H", 23: "h", 25: "H", 26: "H", 27: "H", 28: "H", 29: "H", 30: "H", 31: "H", 33: "H",
    39: "h", 40: "h", 41: "h", 42: "h",
}  # fmt: skip
"""Packets of two bytes; the others have one. 24 is signed."""
DEMO_SPEED_MMPS = 200
STRAIGHT = (-32768, 32767)


@dataclass
class CreateSensors:
    """What the Create's sensors feel; set by whoever has it drive about."""

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
    """`receive` bytes, `advance` time (monotonic, ns), `roll` the wheels; `wheels_mmps` is what its motors are to do.

    The device at the end of a `sim.wire.emulator.Line`.
    """

    def __init__(self, wheel_base_mm: float = WHEEL_BASE_MM) -> None:
        self.around = CreateSensors()
        self.powered = True
        self.wheels_mmps = (0, 0)
        """Left, right."""
        self.acted: list[tuple[int, tuple[int, int]]] = []
        """When its wheels were asked for what, newest last; a log for tests, cleared by them."""
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
        self._way_mm = self._turn_rad = 0.0
        self._total_mm = self._total_rad = 0.0
        self._turn_wheels(0, 0)

    # --- the outside world --------------------------------------------------------------------------

    def power_cycle(self) -> None:
        """Switched off and on, or a brown-out: off mode, nothing streamed, the baud rate as from the factory."""
        self._boot()

    def roll(self, left_m: float, right_m: float) -> None:
        """What its wheels rolled, as its encoders measured it."""
        way_mm = (left_m + right_m) * 500.0
        turn_rad = (right_m - left_m) * 1000.0 / self._wheel_base_mm
        self._way_mm += way_mm
        self._turn_rad += turn_rad
        self._total_mm += way_mm
        self._total_rad += turn_rad

    def receive(self, data: bytes, baud: int, now_ns: int) -> None:
        self._now_ns = now_ns
        if self.powered and baud == self.baud:
            self._input.extend(data)
            self._work()

    def advance(self, baud: int, now_ns: int) -> bytes:
        """What a listener at this baud rate gets by now."""
        self._now_ns = now_ns
        if not self.powered:
            self._out.clear()
            return b""
        self._work()
        self._safety()
        if now_ns >= self._next_frame_ns:
            # It keeps its own pace; where it was not asked for long, it goes on from now.
            self._next_frame_ns = max(self._next_frame_ns + FRAME_NS, now_ns - FRAME_NS)
            if self._streaming and self._stream:
                self._send_frame()
        out = bytes(self._out)
        self._out.clear()
        return out if baud == self.baud else b""

    @property
    def pending(self) -> bytes:
        """What came of a command that is not whole yet."""
        return bytes(self._pending)

    @property
    def deaf(self) -> bool:
        """It was told to wait for something (opcodes 155 to 158), and hears nothing until then."""
        return self._deaf is not None

    # --- commands -----------------------------------------------------------------------------------

    def _work(self) -> None:
        """Take commands from the input, as long as it listens."""
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
        """The commands that passive mode ignores."""
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
        """Safe mode's own: a cliff while moving forward, or backward in a tight turn; a wheel drop; the charger."""
        around = self.around
        dropped = around.drop_left or around.drop_right or around.drop_caster
        if self.mode == SAFE and (dropped or around.charger or (any(around.cliffs) and self._towards_a_cliff())):
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
        around = self.around
        return {
            1: around.drop_left or around.drop_right or around.drop_caster,
            2: around.drop_caster,
            3: around.drop_left,
            4: around.drop_right,
            5: around.bump_left or around.bump_right,
            6: around.bump_left,
            7: around.bump_right,
            9: around.wall,
            10: any(around.cliffs),
            11: around.cliffs[0],
            12: around.cliffs[1],
            13: around.cliffs[2],
            14: around.cliffs[3],
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
        around = self.around
        if packet == 19:
            way, self._way_mm = int(self._way_mm), 0.0
            return min(max(way, -32768), 32767)
        if packet == 20:
            turn, self._turn_rad = int(degrees(self._turn_rad)), 0.0
            return min(max(turn, -32768), 32767)
        if packet in self._requested:
            return self._requested[packet]
        if 9 <= packet <= 12:
            return int(around.cliffs[packet - 9])
        return {
            7: around.bump_right
            | around.bump_left << 1
            | around.drop_right << 2
            | around.drop_left << 3
            | around.drop_caster << 4,
            8: int(around.wall),
            14: around.right_overcurrent << 3 | around.left_overcurrent << 4,
            17: 255,
            18: around.buttons,
            21: 2 if around.charger else 0,
            22: around.voltage_mv,
            23: around.current_ma,
            24: around.temperature_c,
            25: around.charge_mah,
            26: around.capacity_mah,
            34: 2 if around.charger else 0,
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
