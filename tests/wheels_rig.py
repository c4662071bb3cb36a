"""The line of a LeKiwi in virtual time: its cycle and the wheels' core above emulated servos, byte by byte, without
ports, threads and processes. The guard is the pure logic of the real one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

from cocoro.clock import NS
from cocoro.messages import BaseCommand, BaseState
from cocoro.robot import Robot
from services.servos.bus import CheckedPort, ServoBus, find_status
from services.servos.cycle import CycleResult, LineCycle
from services.servos.families import FAMILIES
from services.servos.guard import GuardLogic
from services.servos.wheel_guard import SLOWEST_MPS, packet_to_all
from services.servos.wheel_orders import WheelOrders
from services.servos.wheels import WheelGroup
from sim.wire.emulator import SimplePlant
from sim.wire.line import Direction, Disturbance, FaultKind, LineFault
from sim.wire.models import servo_of
from sim.wire.servo import EmulatedServoBus

MS = 1_000_000
STEP_NS = 2 * MS
PERIOD_NS = 20 * MS
REPLY_S = 0.03
BAUD = 1_000_000
FAMILY = FAMILIES["feetech"]
START_NS = 5 * NS


@cache
def lekiwi() -> Robot:
    return Robot.load(Path("lekiwi"))


class VirtualPort(CheckedPort):
    """A port without a tty: waiting for an answer lets the rig's time pass."""

    def __init__(self, rig: WheelsRig) -> None:
        super().__init__("virtual", BAUD, REPLY_S)
        self._rig = rig

    def openPort(self) -> bool:  # noqa: N802 # the SDK's name
        return True

    def closePort(self) -> None:  # noqa: N802
        pass

    def clearPort(self) -> None:  # noqa: N802
        self.strays += len(self._stream)
        self._stream.clear()
        self._ready = b""

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        self._asked = None if packet[2] == 254 else (packet[2], packet[6] if packet[4] == 2 else 0)
        self._rig.to_servos(bytes(packet))
        return len(packet)

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        self._deadline_s = self._rig.now_ns / NS + self.timeout_s

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return self._rig.now_ns / NS >= self._deadline_s

    def _await(self, number: int, length: int) -> None:
        while self._rig.now_ns / NS < self._deadline_s:
            self._stream += self._rig.from_servos()
            if (found := find_status(bytes(self._stream), number, length, self.refusals)) is not None:
                self._ready = found.packet
                self.strays += len(self._stream) - len(found.packet)
                self._stream.clear()
                return
            self._rig.pass_time()


class WheelsRig:
    """`pass_time` moves the plant, and looks at every step whether the wheels turn."""

    def __init__(self, seed: int = 0, robot: Robot | None = None) -> None:
        self.robot = robot or lekiwi()
        base, units = self.robot.base, FAMILY.units
        self.now_ns = START_NS
        self.bus_of_servos = EmulatedServoBus(servo_of(777, number, 5.0) for number in range(1, 10))
        self.wheels = {one.name: self.bus_of_servos.by_number(one.id) for one in base.servo_places}
        for servo in self.wheels.values():
            servo.put(33, 1)
        self.plant = SimplePlant(None, self.bus_of_servos)
        self._ways = Disturbance("to_device", seed), Disturbance("to_driver", seed)
        self._heard = b""
        self.core = WheelGroup(base, FAMILY)
        self.core.guard_fault = ""
        self.orders = WheelOrders(base, units)
        self.guard = GuardLogic(
            packet_to_all(FAMILY, "moving_speed", self.orders.numbers),
            packet_to_all(FAMILY, "torque_enable", self.orders.numbers),
        )
        self.guarded = True
        """Whether the guard is heard."""
        self.orders.vouch_by(self._vouch)
        settings = {number: dict(FAMILY.wheel_settings) for number in self.orders.numbers}
        self.cycle = LineCycle(FAMILY, settings, [], self.orders)
        self.bus = ServoBus("virtual", BAUD, REPLY_S, FAMILY, port=VirtualPort(self), clock_ns=lambda: self.now_ns)
        self._cycle_ns = self.now_ns
        self.alive = True
        """Whether the service runs; if not, time passes and the guard alone acts."""
        self.plugged = True
        self.wanted: BaseCommand | None = None
        self._commanded_ns = 0
        self.trace: list[tuple[int, Sequence[float]]] = []
        """(ns, speeds of the wheels by the plant, m/s)."""
        self.states: list[BaseState] = []
        self.cycle.begin(self.bus, self.now_ns / NS)

    # --- the wire -----------------------------------------------------------------------------------

    def to_servos(self, data: bytes) -> None:
        if self.plugged:
            self._wire(data)

    def _wire(self, data: bytes) -> None:
        arrived = self._ways[0].carry(data, self.now_ns)
        if arrived:
            self.bus_of_servos.receive(arrived, BAUD, self.now_ns)
        self._heard += self._ways[1].carry(self.bus_of_servos.advance(BAUD, self.now_ns), self.now_ns)

    def from_servos(self) -> bytes:
        self._wire(b"")
        heard, self._heard = self._heard, b""
        return heard if self.plugged else b""

    def disturb(self, kind: FaultKind, share: float, way: Direction = "both") -> None:
        for one in self._ways:
            one.add(LineFault(kind, share, way, 10**19))

    # --- time ---------------------------------------------------------------------------------------

    def pass_time(self) -> None:
        self.now_ns += STEP_NS
        self.plant.advance(self.now_ns)
        self.trace.append((self.now_ns, self.speeds_mps))
        if data := self.guard.poll(self.now_ns):
            self.to_servos(data)

    def run(self, seconds: float, until: Callable[[], object] = lambda: False) -> None:
        """Let time pass; the service runs its cycles, and is commanded, meanwhile."""
        end_ns = self.now_ns + round(seconds * NS)
        while self.now_ns < end_ns and not until():
            if self.alive and self.now_ns >= self._cycle_ns:
                self._cycle_ns = max(self._cycle_ns + PERIOD_NS, self.now_ns)
                self._serve()
            self.pass_time()

    def _serve(self) -> None:
        if self.guarded:
            self.orders.guarded(self.now_ns + 250 * MS)
        self.take(self.cycle.run(self.bus, lambda: self.now_ns / NS, self.core.next_task()))

    def take(self, result: CycleResult) -> None:
        result.of(self.core.servos).tell(self.core, self.now_ns, self.now_ns)
        if self.wanted is not None:
            self._commanded_ns, self.wanted.stamp_ns = self.now_ns, self.now_ns
            self.core.command(self.wanted, self.now_ns)
        self.order()
        if (state := self.core.state(self.now_ns)) is not None:
            self.states.append(state)

    def order(self) -> None:
        """Give the line what the core orders, as the service does."""
        wheels_mps, for_ns = self.core.wheels(self.now_ns)
        self.orders.give(wheels_mps, self.now_ns + for_ns)

    def _vouch(self, fastest_mps: float) -> None:
        self.guard.vouch(fastest_mps > SLOWEST_MPS, self.now_ns + round(self.robot.base.patience_s(fastest_mps) * NS))

    # --- the truth ----------------------------------------------------------------------------------

    @property
    def speeds_mps(self) -> tuple[float, ...]:
        """By wheel, the speed of its rim by the plant."""
        speeds = self.plant.speeds()
        return tuple(
            speeds[servo.number] * FAMILY.units.speed_radps * wheel.radius_m
            for servo, wheel in zip(self.wheels.values(), self.robot.base.wheel, strict=True)
        )

    def stood_after(self, since_ns: int) -> float:
        """Seconds from `since_ns` until the wheels stood, for good."""
        moving = [at_ns for at_ns, speeds in self.trace if max(abs(mps) for mps in speeds) > 0.005]
        return (max((at_ns for at_ns in moving if at_ns > since_ns), default=since_ns) - since_ns) / NS

    # --- what tests do ------------------------------------------------------------------------------

    def release(self) -> WheelsRig:
        """Release the stop, and let the service enable the wheels."""
        self.core.set_latch("released")
        self.run(1.0, lambda: self.core.ready)
        assert self.core.ready, self.core.faults(self.now_ns)
        return self

    def drive(self, ahead_mps: float = 0.0, turn_radps: float = 0.0, aside_mps: float = 0.0) -> None:
        """Command from now on, in each cycle."""
        self.wanted = BaseCommand(ahead_mps=ahead_mps, turn_radps=turn_radps, aside_mps=aside_mps)
