"""The core of a base whose wheels are turned by servos: commands and readings in, speeds, state and faults out. Pure.

It is to the rest of the robot what `services.base.driver` is for a Create. The odometry goes by the servos' positions,
which run on from turn to turn, so it knows no more of slip than they do.
"""

from __future__ import annotations

from collections.abc import Sequence

from cocoro.base import Base
from cocoro.clock import NS
from cocoro.messages import BaseCommand, BaseState, LatchState
from cocoro.messages.hardware import STOPPED_BY
from cocoro.odometry import Odometry
from cocoro.omni import OmniWheel, WheelServo
from cocoro.wheel_commands import WheelCommands, fastest_mps
from services.servos.family import ServoFamily, ServoReading
from services.servos.watch import ServoWatch, WatchedServo

FRESH_NS = 180_000_000
"""The state is published only while no wheel's newest reading is older than this."""
LEAP_MPS, LEAP_COUNTS, LEAPS = 2.0, 40, 3
"""A position that a wheel cannot have come to since its last one, at this many times its highest speed, is not
believed: one damaged answer in 256 has a valid checksum. After so many in a row it is: it was turned meanwhile."""
HELD_SHARE, HELD_FROM_MPS, HELD_NS, HELD_READINGS = 0.4, 0.04, NS // 10, 6
"""A wheel that turns at less than this share of its ordered speed, if that is fast enough to tell, for this long and by
so many readings in a row is held up. A servo's own protection against overload takes 2 s."""
LET_GO_NS = NS
"""Wheels that were held up may turn again when nothing was asked of them for this long."""


class WheelJoint(WatchedServo):
    """The servo of one wheel."""

    def __init__(self, wheel: OmniWheel, servo: WheelServo, base: Base, family: ServoFamily) -> None:
        super().__init__(f"wheel {wheel.name}", servo.id)
        units = family.units
        self._turn_counts = units.counts
        self._metres_a_count = servo.direction * units.count_rad * wheel.radius_m
        self._metres_a_speed = servo.direction * units.speed_radps * wheel.radius_m
        self._leap_counts_a_s = LEAP_MPS * base.max_wheel_speed_mps / (units.count_rad * wheel.radius_m)
        self._place: tuple[int, int] | None = None
        """Position, counts, and when it was read."""
        self._leaps = 0
        self._seen: ServoReading | None = None
        self.is_rolled = False
        """Whether `rolled_m` goes up to the newest reading."""
        self.rolled_m = 0.0
        """Since the odometry took it last."""
        self.held_since_ns: int | None = None
        self._held_readings = 0

    @property
    def speed_mps(self) -> float:
        """Of its rim, as its servo measures it."""
        return 0.0 if self.reading is None else self.reading.speed * self._metres_a_speed

    @property
    def is_new(self) -> bool:
        """Whether its newest reading was not looked at yet."""
        return self.reading is not self._seen

    def turned(self) -> None:
        """Add to `rolled_m` what the newest reading tells."""
        assert self.reading is not None
        self._seen = self.reading
        before, self._place = self._place, (self.reading.position, self.read_ns)
        self.is_rolled = True
        if before is None:
            return
        half = self._turn_counts // 2
        counts = (self._place[0] - before[0] + half) % self._turn_counts - half
        most = LEAP_COUNTS + self._leap_counts_a_s * max(self.read_ns - before[1], 0) / NS
        if abs(counts) <= most:
            self._leaps = 0
            self.rolled_m += counts * self._metres_a_count
        elif self._leaps < LEAPS:
            self._leaps += 1
            self._place, self.is_rolled = before, False
        else:
            self._leaps = 0

    def feel(self, ordered_mps: float, now_ns: int) -> None:
        """Note whether it turns as ordered."""
        ahead_mps = self.speed_mps if ordered_mps > 0 else -self.speed_mps
        if abs(ordered_mps) < HELD_FROM_MPS or ahead_mps >= HELD_SHARE * abs(ordered_mps):
            self.held_since_ns = None
        elif self.held_since_ns is None or self.held_since_ns > now_ns:
            self.held_since_ns, self._held_readings = now_ns, 1
        else:
            self._held_readings += 1

    def is_held(self, now_ns: int) -> bool:
        """Whether it has not turned as ordered for too long."""
        if self.held_since_ns is None or self._held_readings < HELD_READINGS:
            return False
        return now_ns - self.held_since_ns >= HELD_NS

    def forget_time(self) -> None:
        """The clock restarted."""
        self.read_ns, self.held_since_ns = 0, None
        if self._place is not None:
            self._place = self._place[0], 0


class WheelGroup(ServoWatch[WheelJoint]):
    """The servos of a base's wheels, all on one line. Every `now_ns` is the robot's clock."""

    remedy = "cocoro base recover"

    def __init__(self, base: Base, family: ServoFamily) -> None:
        servos = [(wheel, wheel.servo) for wheel in base.wheel if wheel.servo is not None]
        super().__init__((WheelJoint(wheel, servo, base, family) for wheel, servo in servos), family)
        self.guard_fault = "the guard of the wheels has not reported yet"
        """Why nobody watches over this process; '' when the guard does."""
        self.held_up = ""
        """What is known of a wheel that did not turn; '' when all turned."""
        self._commands = WheelCommands(base)
        self._odometry = Odometry(base.drive)
        self._rolled_ns: int | None = None
        self._asked_ns: int | None = None
        """When wheels that are held up were asked to turn last."""

    # --- commands -----------------------------------------------------------------------------------

    @property
    def latch(self) -> LatchState:
        return self._commands.latch

    def command(self, command: BaseCommand, now_ns: int) -> None:
        """See `WheelCommands.command`."""
        self._commands.command(command, now_ns)

    def set_latch(self, state: LatchState) -> None:
        """See `WheelCommands.set_latch`. A release enables servos that are not, and after an emergency stop it also
        clears the faults."""
        before = self._commands.latch
        self._commands.set_latch(state)
        if state == "released":
            self._released(before)
            self.held_up = "" if before == "latched" else self.held_up

    def recover(self) -> None:
        """The operator lets the wheels turn again: latched faults are cleared, servos that are not are enabled."""
        self.held_up = ""
        self.clear(())
        for one in self.servos.values():
            self._enable_if_due(one)

    def new_epoch(self) -> None:
        self._commands.new_epoch()
        self._rolled_ns = self._asked_ns = None
        for one in self.servos.values():
            one.forget_time()

    @property
    def ready(self) -> bool:
        """Whether the wheels may turn, as far as their servos and their guard are concerned."""
        obey = all(one.obeys for one in self.servos.values())
        return obey and not self.port_fault and not self.guard_fault and not self.held_up

    def wheels(self, now_ns: int) -> tuple[Sequence[float], int]:
        """By wheel the speed to turn at, m/s, and for how long from now, ns."""
        wheels_mps, for_ns = self._commands.wheels(now_ns)
        return (wheels_mps if self.ready else (0.0,) * len(self.servos)), for_ns

    # --- results of the line ------------------------------------------------------------------------

    def moved(self, spun_mps: Sequence[float], now_ns: int) -> None:
        if not spun_mps:  # the line failed
            return
        servos = self.servos.values()
        for one, ordered_mps in zip(servos, spun_mps, strict=True):
            if one.is_new:
                one.turned()
                one.feel(ordered_mps, now_ns)
        if all(one.is_rolled for one in servos):
            self._roll()
        self._feel(now_ns)

    def _roll(self) -> None:
        """Advance the odometry by what all wheels have rolled since it was last."""
        servos = list(self.servos.values())
        at_ns = sum(one.read_ns for one in servos) // len(servos)
        if self._rolled_ns is not None and at_ns <= self._rolled_ns:  # the clock jumped: what has rolled waits
            return
        before_ns, self._rolled_ns = self._rolled_ns, at_ns
        if before_ns is not None:
            self._odometry.advance([one.rolled_m for one in servos], (at_ns - before_ns) / NS)
            self._odometry.measured([one.speed_mps for one in servos])
        for one in servos:
            one.rolled_m, one.is_rolled = 0.0, False

    def _feel(self, now_ns: int) -> None:
        """Stop the wheels when one is held up, until nothing is asked of them for a while."""
        wheels_mps, _ = self._commands.wheels(now_ns)
        if self._asked_ns is None or self._asked_ns > now_ns or fastest_mps(wheels_mps) > 0.0:
            self._asked_ns = now_ns
        if self.held_up and now_ns - self._asked_ns > LET_GO_NS:
            self.held_up = ""
        for one in self.servos.values():
            if one.is_held(now_ns) and not self.held_up:
                self.held_up = f"{one.name} is held up: it does not turn as ordered. Is it blocked?"

    def port_lost(self, why: str) -> None:
        super().port_lost(why)
        for one in self.servos.values():
            one.held_since_ns = None

    # --- state --------------------------------------------------------------------------------------

    def state(self, now_ns: int) -> BaseState | None:
        """The state at the newest readings; None when a wheel's is older than `FRESH_NS`."""
        servos = list(self.servos.values())
        readings = [one.reading for one in servos if one.reading is not None and not one.silent]
        if self._rolled_ns is None or len(readings) < len(servos) or not 0 <= now_ns - self._rolled_ns <= FRESH_NS:
            return None
        odometry = self._odometry
        return BaseState(
            stamp_ns=self._rolled_ns,
            odometry_m=(odometry.x_m, odometry.y_m),
            odometry_yaw_rad=odometry.yaw_rad,
            speed_mps=odometry.speed_mps,
            turn_rate_radps=odometry.turn_rate_radps,
            aside_mps=odometry.aside_mps,
            overcurrent=self.overcurrent,
            battery_v=min(reading.voltage_v for reading in readings),
            latch=self.latch,
            stopped_by=self.stopped_by(now_ns),
        )

    @property
    def overcurrent(self) -> bool:
        """Whether a wheel does not turn although its motor pushes."""
        return bool(self.held_up) or any("overload" in one.fault or "current" in one.fault for one in self._all)

    @property
    def _all(self) -> Sequence[WheelJoint]:
        return tuple(self.servos.values())

    def stopped_by(self, now_ns: int) -> str:
        if (latched := STOPPED_BY[self.latch]) or self.ready:
            return latched or self._commands.stopped_by(now_ns)
        return "overcurrent" if self.overcurrent else "link"

    def faults(self, now_ns: int) -> tuple[str, ...]:
        found = super().faults(now_ns)
        if self.port_fault:
            return found
        return (*((self.guard_fault,) if self.guard_fault else ()), *found, *((self.held_up,) if self.held_up else ()))
