"""The Create as its driver finds it: reflexes at the hardware, ramped wheels, counters in whole units.

Pure: told the time and what its wheels and bumper did, asked how its wheels are to turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees

from cocoro.messages import BaseCommand, BaseState, LatchState
from cocoro.odometry import REPORT_PERIOD_S, Odometry, WheelRamp
from cocoro.robot import Base


class CreateCounters:
    """Way and turn since they were last asked for, whole millimetres and degrees; the rest is forgotten."""

    def __init__(self, separation_m: float) -> None:
        self._separation_m = separation_m
        self._way_m = 0.0
        self._turn_rad = 0.0

    def roll(self, left_m: float, right_m: float) -> None:
        """Count what the wheels' encoders measured."""
        self._way_m += (left_m + right_m) / 2
        self._turn_rad += (right_m - left_m) / self._separation_m

    def take(self) -> tuple[int, int]:
        """distance in mm and angle in degrees, rounded towards zero; both counters start anew."""
        report = int(self._way_m * 1000.0), int(degrees(self._turn_rad))
        self._way_m = self._turn_rad = 0.0
        return report


@dataclass(frozen=True)
class Bumper:
    left: bool = False
    right: bool = False

    @property
    def pressed(self) -> bool:
        return self.left or self.right


class MobileBase:
    """The base service: deadman, emergency stop, bump reflex, ramp and odometry.

    With `exact` the odometry is that of perfect encoders, otherwise what a driver makes of the Create's reports.
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
        """Why the wheels do not turn as they were asked to; '' when they do."""

    def command(self, command: BaseCommand, now_ns: int) -> str:
        """Take wheel speeds, valid for as long as `Base.patience_s` has it from when they were said (without a stamp:
        from now). Returns '' when taken, otherwise why not."""
        if self.latch != "released":
            return _latch_text(self.latch)
        self._wanted = command.left_mps, command.right_mps
        said_ns = min(command.stamp_ns or now_ns, now_ns)
        self._valid_until_ns = said_ns + round(self._base.patience_s(self._faster_mps()) * 1e9)
        return ""

    def _faster_mps(self) -> float:
        """The faster wheel's speed, of what is wanted."""
        return min(max(abs(speed) for speed in self._wanted), self._base.max_wheel_speed_mps)

    def set_latch(self, state: LatchState) -> None:
        """Latched and unknown command zero; a command from before counts no more after the release. From any thread."""
        self.latch = state
        self._valid_until_ns = -1

    def wheels(self, now_ns: int, dt_s: float) -> tuple[float, float]:
        """Advance the ramp by one step. Returns the wheel speeds that the motors are to turn at, left and right."""
        left, right = self._obeyed(now_ns)
        self.ramp.advance(left, right, dt_s)
        return self.ramp.left_mps, self.ramp.right_mps

    def rolled(self, left_m: float, right_m: float, now_ns: int, dt_s: float) -> None:
        """What the encoders measured in the step that ended now."""
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

    def _obeyed(self, now_ns: int) -> tuple[float, float]:
        """The commanded speeds as far as the reflexes let them through."""
        self.stopped_by = ""
        if self.latch != "released":
            self.stopped_by = _latch_text(self.latch)
            return 0.0, 0.0
        if now_ns > self._valid_until_ns:
            self.stopped_by = "no command"
            return 0.0, 0.0
        left, right = self._wanted
        if self.bumper.pressed and left + right > 0.0:
            # Forward is forbidden, turning on the spot is not: a round base may turn away.
            self.stopped_by = "bump"
            ahead = (left + right) / 2
            return left - ahead, right - ahead
        return left, right


def _latch_text(latch: LatchState) -> str:
    return {"released": "", "latched": "estop", "unknown": "latch unknown"}[latch]
