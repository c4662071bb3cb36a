"""The orders to the wheels on a line, which the event loop gives and the line's thread writes.

A wheel turns on at its last speed, so the thread itself watches over it: by CLOCK_MONOTONIC, and whatever the event
loop does, the wheels turn only while their order has not expired, no emergency stop came, every wheel answers, and
their guard watches this process (`services.servos.guard`). Else they brake by the base's ramp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from cocoro.base import Base
from cocoro.clock import NS
from cocoro.odometry import WheelRamp
from cocoro.servo_units import ServoUnits

LONGEST_S = 0.1
"""The longest time for which the ramp goes on in one step: a thread that was late does not make wheels leap."""


class WheelOrder(NamedTuple):
    until_ns: int
    """CLOCK_MONOTONIC."""
    wheels_mps: Sequence[float]


class WheelOrders:
    def __init__(self, base: Base, units: ServoUnits) -> None:
        """A base whose wheels are turned by servos with these units."""
        servos = [(wheel, wheel.servo) for wheel in base.wheel if wheel.servo is not None]
        self.numbers = tuple(servo.id for _, servo in servos)
        self.rest: Mapping[int, int] = dict.fromkeys(self.numbers, 0)
        self._counts_a_metre = [servo.direction / (units.speed_radps * wheel.radius_m) for wheel, servo in servos]
        self._base = base
        self._still = (0.0,) * len(servos)
        self._order = WheelOrder(0, self._still)
        self._halted = False
        self._guarded_ns = 0
        self._vouch: Callable[[float], None] = lambda _: None
        self._then_s: float | None = None
        self._ramp = WheelRamp(base)

    def give(self, wheels_mps: Sequence[float], until_ns: int) -> None:
        """Turn the wheels at these speeds until `until_ns`. Must be renewed before."""
        self._order = WheelOrder(until_ns, wheels_mps)  # one assignment: the thread sees the old or the new

    def halt(self) -> None:
        """Brake, whatever is ordered. Thread-safe, and independent of the event loop."""
        self._halted = True

    def go_on(self) -> None:
        """Obey orders again. Call it after `give` with orders that respect the emergency stop."""
        self._halted = False

    def guarded(self, until_ns: int) -> None:
        """The guard was heard, and counts as awake until `until_ns`."""
        self._guarded_ns = until_ns

    def vouch_by(self, vouch: Callable[[float], None]) -> None:
        """Call `vouch(fastest_mps)`, in the line's thread, whenever the wheels' speeds were written."""
        self._vouch = vouch

    # --- in the line's thread -----------------------------------------------------------------------

    @property
    def spun_mps(self) -> tuple[float, ...]:
        """By wheel, the speed that was ordered last."""
        return self._ramp.wheels_mps

    def begin(self, now_s: float) -> Mapping[int, int]:
        """The line was opened: the wheels stand from now on."""
        self._ramp = WheelRamp(self._base)
        self._then_s = now_s
        return self.rest

    def due(self, now_s: float, *, answering: bool) -> Mapping[int, int]:
        """By servo ID the speed to write now, counts per second. `answering`: whether every wheel does."""
        dt_s = 0.0 if self._then_s is None else min(now_s - self._then_s, LONGEST_S)
        self._then_s = now_s
        until_ns, wheels_mps = self._order
        now_ns = round(now_s * NS)
        may = answering and not self._halted and now_ns <= until_ns and now_ns <= self._guarded_ns
        self._ramp.advance(wheels_mps if may else self._still, max(dt_s, 0.0))
        counts = [
            round(speed_mps * share)
            for speed_mps, share in zip(self._ramp.wheels_mps, self._counts_a_metre, strict=True)
        ]
        return dict(zip(self.numbers, counts, strict=True))

    def written(self) -> None:
        """What `due` gave was written."""
        self._vouch(self._ramp.fastest_mps)
