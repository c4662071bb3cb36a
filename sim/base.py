"""The simulated base: the Create's reflexes, wheel ramp and counters, and the base service's deadman and odometry.

Pure. The world passes in the time and what the wheels and the bumper did, and asks for the wheel speeds to drive.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees

from cocoro.description import Base
from cocoro.differential import wheels_of
from cocoro.messages import BaseCommand, BaseState, LatchState
from cocoro.messages.hardware import STOPPED_BY
from cocoro.odometry import REPORT_PERIOD_S, Odometry, WheelRamp


class CreateCounters:
    """Distance and angle since the last reading, in whole millimetres and degrees; the remainder is lost, as on a
    Create."""

    def __init__(self, separation_m: float) -> None:
        self._separation_m = separation_m
        self._distance_m = 0.0
        self._turn_rad = 0.0

    def roll(self, left_m: float, right_m: float) -> None:
        """Add what the wheel encoders measured."""
        self._distance_m += (left_m + right_m) / 2
        self._turn_rad += (right_m - left_m) / self._separation_m

    def take(self) -> tuple[int, int]:
        """Distance in mm and angle in degrees, rounded towards zero. Resets both counters."""
        report = int(self._distance_m * 1000.0), int(degrees(self._turn_rad))
        self._distance_m = self._turn_rad = 0.0
        return report


@dataclass(frozen=True)
class Bumper:
    left: bool = False
    right: bool = False

    @property
    def pressed(self) -> bool:
        return self.left or self.right


class MobileBase:
    """The base service and its Create: deadman, emergency stop, bump reflex, ramp and odometry.

    With `exact` the odometry comes from perfect encoders, otherwise from the Create's reports, as in a real driver.
    """

    def __init__(self, base: Base, *, exact: bool) -> None:
        self.ramp = WheelRamp(base)
        self.odometry = Odometry(base)
        self.latch: LatchState = "released"
        self.bumper = Bumper()
        self._base = base
        self._exact = exact
        self._counters = CreateCounters(base.wheel_separation_m)
        self._wanted = (0.0, 0.0)
        self._valid_until_ns = -1
        self._next_report_ns = 0
        self.stopped_by = ""
        """Why the wheels do not turn as commanded; '' when they do."""

    def command(self, command: BaseCommand, now_ns: int) -> str:
        """Accept speeds. They expire `Base.patience_s` after the command's stamp (without a stamp: after now).
        Returns '' when accepted, otherwise the reason for refusing."""
        if self.latch != "released":
            return STOPPED_BY[self.latch]
        try:
            self._wanted = wheels_of(self._base, command)
        except ValueError as error:
            return str(error)
        sent_ns = min(command.stamp_ns or now_ns, now_ns)
        self._valid_until_ns = sent_ns + round(self._base.patience_s(self._faster_mps()) * 1e9)
        return ""

    def _faster_mps(self) -> float:
        """Commanded speed of the faster wheel."""
        return min(max(abs(speed) for speed in self._wanted), self._base.max_wheel_speed_mps)

    def set_latch(self, state: LatchState) -> None:
        """Latched and unknown stop the wheels; a release does not revive an earlier command. Thread-safe."""
        self.latch = state
        self._valid_until_ns = -1

    def wheels(self, now_ns: int, dt_s: float) -> tuple[float, float]:
        """Advance the ramp by one step. Returns the speeds to drive the left and the right wheel at, m/s."""
        left, right = self._allowed_mps(now_ns)
        self.ramp.advance(left, right, dt_s)
        return self.ramp.left_mps, self.ramp.right_mps

    def rolled(self, left_m: float, right_m: float, now_ns: int, dt_s: float) -> None:
        """Take what the encoders measured in the step that ended now."""
        if self._exact:
            self.odometry.advance(left_m, right_m, dt_s)
            return
        self._counters.roll(left_m, right_m)
        self.odometry.advance(self.ramp.left_mps * dt_s, self.ramp.right_mps * dt_s, dt_s)
        if now_ns >= self._next_report_ns:
            self._next_report_ns = now_ns + round(REPORT_PERIOD_S * 1e9)
            self.odometry.report(*self._counters.take())

    def state(self, now_ns: int) -> BaseState:
        odometry = self.odometry
        return BaseState(
            stamp_ns=now_ns,
            odometry_m=(odometry.x_m, odometry.y_m),
            odometry_yaw_rad=odometry.yaw_rad,
            speed_mps=odometry.speed_mps,
            turn_rate_radps=odometry.turn_rate_radps,
            bump_left=self.bumper.left,
            bump_right=self.bumper.right,
            latch=self.latch,
            stopped_by=self.stopped_by,
        )

    def _allowed_mps(self, now_ns: int) -> tuple[float, float]:
        """The part of the commanded speeds that deadman, emergency stop and bump reflex allow; left, right."""
        self.stopped_by = ""
        if self.latch != "released":
            self.stopped_by = STOPPED_BY[self.latch]
            return 0.0, 0.0
        if now_ns > self._valid_until_ns:
            self.stopped_by = "no command"
            return 0.0, 0.0
        left, right = self._wanted
        if self.bumper.pressed and left + right > 0.0:
            # A round base may still turn on the spot.
            self.stopped_by = "bump"
            forward = (left + right) / 2
            return left - forward, right - forward
        return left, right
