"""The base service's core: odometry, state and faults from the guard's reports, and wheel speeds to ask for. Pure."""

from __future__ import annotations

import msgspec

from cocoro.base import Base
from cocoro.clock import NS
from cocoro.health import WINDOW_S, Recent
from cocoro.messages import BaseCommand, BaseState, LatchState
from cocoro.messages.hardware import STOPPED_BY
from cocoro.odometry import Odometry, WheelRamp
from cocoro.wheel_commands import WheelCommands
from services.base import oi
from services.base.guard_logic import LinkState

FRESH_NS = 180_000_000
"""The state is published only while the newest frame is not older than this."""
LONGEST_S = 0.25
"""Longest gap between two frames over which the commanded speeds are integrated; the Create's own count corrects the
rest."""
BATTERY_LOW = 0.15


class GuardReport(msgspec.Struct):
    """A report of the guard: a frame of the Create, or that there is none."""

    t: int
    """CLOCK_MONOTONIC, ns."""
    link: LinkState
    why: str
    """Why the wheels do not turn as asked, or why the port does not work; '' when neither."""
    left: int
    """Newest command to the Create, mm/s."""
    right: int
    stops: int = 0
    """Count of emergency stops that the guard received on its own address."""
    damage: int = 0
    """Count of bytes and commands that were damaged on the line."""
    readings: dict[int, int] | None = None
    counts_lost: bool = False


class BaseDriver:
    """Every `now_ns` is the robot's clock."""

    def __init__(self, base: Base) -> None:
        self.link: LinkState = "closed"
        self.why = "the guard has not reported yet"
        self._commands = WheelCommands(base)
        self._odometry = Odometry(base.drive)
        self._ramp = WheelRamp(base)
        self._readings: oi.Readings = {}
        self._frame_ns: int | None = None
        self._damage = 0
        self._damaged = Recent()
        self._reported_ns = 0

    # --- commands -----------------------------------------------------------------------------------

    @property
    def latch(self) -> LatchState:
        return self._commands.latch

    def command(self, command: BaseCommand, now_ns: int) -> None:
        """See `WheelCommands.command`."""
        self._commands.command(command, now_ns)

    def set_latch(self, state: LatchState) -> None:
        """See `WheelCommands.set_latch`. Thread-safe."""
        self._commands.set_latch(state)

    def new_epoch(self) -> None:
        """The clock restarted: earlier commands and frames belong to no time of the new epoch."""
        self._commands.new_epoch()
        self._frame_ns = None

    def wheels(self, now_ns: int) -> tuple[int, int, int]:
        """Left and right speed to ask the guard for, mm/s, and for how long from now, ns."""
        (left_mps, right_mps), for_ns = self._commands.wheels(now_ns)
        return round(left_mps * 1000.0), round(right_mps * 1000.0), for_ns

    # --- reports ------------------------------------------------------------------------------------

    def take(self, report: GuardReport, now_ns: int) -> None:
        """Take a report that was made at `now_ns`."""
        self.link, self.why = report.link, report.why
        self._damaged.add(report.damage - self._damage, report.t)
        self._damage, self._reported_ns = report.damage, report.t
        readings = report.readings
        if readings is None:
            return
        self._readings = readings
        self._roll(readings, now_ns)
        if report.counts_lost:
            self._odometry.unreported()
        elif oi.DISTANCE in readings:
            self._odometry.report(readings[oi.DISTANCE], readings[oi.ANGLE])
        self._frame_ns = now_ns

    def _roll(self, readings: oi.Readings, now_ns: int) -> None:
        """Advance the odometry by the speeds that the Create reports as commanded in the frame."""
        if self._frame_ns is None or now_ns <= self._frame_ns:
            return
        dt_s = min((now_ns - self._frame_ns) / NS, LONGEST_S)
        obeying = oi.MODES[readings[oi.MODE]] in ("safe", "full")
        left_mps, right_mps = (readings[side] / 1000.0 if obeying else 0.0 for side in (oi.LEFT_SPEED, oi.RIGHT_SPEED))
        before = self._ramp.wheels_mps
        self._ramp.advance((left_mps, right_mps), dt_s)
        rolled_m = [(was + now) / 2 * dt_s for was, now in zip(before, self._ramp.wheels_mps, strict=True)]
        self._odometry.advance(rolled_m, dt_s)

    # --- state --------------------------------------------------------------------------------------

    def state(self, now_ns: int) -> BaseState | None:
        """The state at the newest frame; None when that is older than `FRESH_NS`."""
        if self._frame_ns is None or not 0 <= now_ns - self._frame_ns <= FRESH_NS:
            return None
        readings, odometry = self._readings, self._odometry
        bumps = readings[oi.BUMPS]
        return BaseState(
            stamp_ns=self._frame_ns,
            odometry_m=(odometry.x_m, odometry.y_m),
            odometry_yaw_rad=odometry.yaw_rad,
            speed_mps=odometry.speed_mps,
            turn_rate_radps=odometry.turn_rate_radps,
            aside_mps=odometry.aside_mps,
            bump_left=bool(bumps & oi.BUMP_LEFT),
            bump_right=bool(bumps & oi.BUMP_RIGHT),
            wheel_drop=bool(bumps & oi.WHEEL_DROPS),
            cliff=any(readings[packet] for packet in oi.CLIFFS),
            overcurrent=bool(readings[oi.OVERCURRENTS] & oi.WHEEL_OVERCURRENTS),
            buttons=tuple(
                name for name, bit in (("play", oi.PLAY), ("advance", oi.ADVANCE)) if readings[oi.BUTTONS] & bit
            ),
            mode=self.mode,
            battery_fraction=self.battery_fraction,
            battery_v=readings[oi.VOLTAGE] / 1000.0,
            charging=readings[oi.CHARGING] in oi.CHARGES,
            latch=self.latch,
            stopped_by=self.stopped_by(now_ns),
        )

    @property
    def mode(self) -> oi.Mode:
        return oi.MODES[self._readings.get(oi.MODE, 0)]

    @property
    def battery_fraction(self) -> float:
        capacity = self._readings.get(oi.CAPACITY, 0)
        return min(self._readings[oi.CHARGE] / capacity, 1.0) if capacity else 0.0

    def stopped_by(self, now_ns: int) -> str:
        if (latched := STOPPED_BY[self.latch]) or self.link == "up":
            return latched or self._commands.stopped_by(now_ns) or self.why
        return "mode" if self.link == "fallen" else "link"

    def faults(self) -> tuple[str, ...]:
        """The base's faults, for people, most fundamental first."""
        if self.link in ("closed", "silent"):
            return (f"no connection to the Create: {self.why}" if self.link == "closed" else SILENT,)
        if not self._readings:
            return ()
        found = []
        if self.link == "fallen":
            found.append(f"the Create fell back to {self.mode} mode{self._fall()}; `cocoro base recover`")
        bumps = self._readings[oi.BUMPS]
        if bumps & oi.WHEEL_DROPS:
            found.append("a wheel hangs in the air")
        if any(self._readings[packet] for packet in oi.CLIFFS):
            found.append("a cliff is below a sensor")
        if self._readings[oi.OVERCURRENTS] & oi.WHEEL_OVERCURRENTS:
            found.append("a wheel draws too much current: is it blocked?")
        if damage := self._damaged.total(self._reported_ns):
            found.append(f"its line is disturbed, check the cable: {damage} damaged bytes in {WINDOW_S:g} s")
        if self.battery_fraction < BATTERY_LOW:
            found.append(f"the battery is low: {100 * self.battery_fraction:.0f}%")
        return tuple(found)

    def _fall(self) -> str:
        return " at the charger" if self._readings[oi.CHARGERS] else ""


SILENT = "the Create does not answer: is it switched on, is its cable plugged in?"
