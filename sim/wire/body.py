"""A body without physics: wheels ramp to what they are told, servos turn towards their goals, nothing is in the way."""

from __future__ import annotations

from math import copysign

from cocoro.clock import NS
from sim.wire.create import Create
from sim.wire.dynamixel import Bus, Servo

WHEEL_MPS2 = 2.0
FULL_SPEED = 530
"""What a servo without load reaches, in counts of 0.111 rpm: 59 rpm."""
COUNTS_A_SPEED_COUNT = 0.111 * 360 / 60 / 300 * 1023
"""Position counts a second for each count of speed."""
STEP_NS = 50_000_000


class SimpleBody:
    """For tests and first steps. `blocked` servos do not turn, and strain."""

    def __init__(self, create: Create | None = None, *buses: Bus) -> None:
        self.wheels_mps = [0.0, 0.0]
        self.rolled_m = [0.0, 0.0]
        self.blocked: set[int] = set()
        self._create = create
        self._shafts = [(servo, _Shaft(servo)) for bus in buses for servo in bus.servos]
        self._then_ns: int | None = None

    def turn_by_hand(self, number: int, count: int) -> None:
        """Somebody turns a limp servo."""
        for servo, shaft in self._shafts:
            if servo.number == number and not servo.motor.on:
                shaft.count = float(count)

    def fileno(self) -> int:
        return -1

    def advance(self, now_ns: int) -> None:
        dt_s = 0.0 if self._then_ns is None else min(now_ns - self._then_ns, STEP_NS) / NS
        self._then_ns = now_ns
        if self._create is not None:
            self._roll(self._create, dt_s)
        for servo, shaft in self._shafts:
            shaft.turn(dt_s, servo.number in self.blocked, now_ns)

    def _roll(self, create: Create, dt_s: float) -> None:
        for side, wanted_mmps in enumerate(create.wheels_mmps):
            change = wanted_mmps / 1000.0 - self.wheels_mps[side]
            self.wheels_mps[side] += copysign(min(abs(change), WHEEL_MPS2 * dt_s), change)
        rolled = [speed * dt_s for speed in self.wheels_mps]
        self.rolled_m = [way + more for way, more in zip(self.rolled_m, rolled, strict=True)]
        create.roll(*rolled)


class _Shaft:
    def __init__(self, servo: Servo) -> None:
        self._servo = servo
        self.count = float(servo.get(36))

    def turn(self, dt_s: float, blocked: bool, now_ns: int) -> None:
        motor = self._servo.motor
        speed = load = 0.0
        error = motor.goal - self.count
        if motor.on and motor.limit > 0.0 and abs(error) >= 0.5:
            share = min(max(abs(error) / motor.slope, motor.punch), 1.0)
            load = copysign(motor.limit * share if blocked else 0.05 * motor.limit, error)
            if not blocked and dt_s > 0.0:
                fastest = motor.speed or FULL_SPEED
                step = min(abs(error), min(fastest, FULL_SPEED) * COUNTS_A_SPEED_COUNT * dt_s)
                speed = copysign(step / COUNTS_A_SPEED_COUNT / dt_s, error)
                self.count += copysign(step, error)
        self._servo.sense(round(self.count), round(speed), load, now_ns)
