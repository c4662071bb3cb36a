"""The simulated base: the Create's reflexes, wheel ramp and counters, and the base service's deadman and odometry.

Pure. The world passes in the time and what the wheels and the bumper did, and asks for the wheel speeds to drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees

from cocoro.base import Base
from cocoro.drive import Twist, WheelDrive
from cocoro.messages import BaseCommand, BaseState, LatchState
from cocoro.messages.hardware import STOPPED_BY
from cocoro.odometry import REPORT_PERIOD_S, Odometry, WheelRamp


class CreateCounters:
    """Distance and angle since the last reading, in whole millimetres and degrees; the remainder is lost, as on a
    Create."""

    def __init__(self, drive: WheelDrive) -> None:
        self._drive = drive
        self._distance_m = 0.0
        self._turn_rad = 0.0

    def roll(self, rolled_m: Sequence[float]) -> None:
        """Add what the wheel encoders measured."""
        ahead_m, turn_rad, _ = self._drive.twist(rolled_m)
        self._distance_m += ahead_m
        self._turn_rad += turn_rad

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
    """The base service and its wheels: deadman, emergency stop, bump reflex, ramp and odometry.

    With `exact` the odometry comes from perfect encoders, otherwise from the Create's reports, as in a real driver.
    Omni wheels always have encoders of their own: the odometry of such a base is wrong only by how its wheels differ
    and slip.
    """

    def __init__(self, base: Base, *, exact: bool) -> None:
        self._drive = base.drive
        self.ramp = WheelRamp(base)
        self.odometry = Odometry(self._drive)
        self.latch: LatchState = "released"
        self.bumper = Bumper()
        self._base = base
        self._exact = exact or base.kind != "differential"
        self._counters = CreateCounters(self._drive)
        self._rest = self._wanted = self.ramp.wheels_mps
        self._asked = Twist()
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
            self._wanted = self._drive.wheels_of(command)
            self._asked = Twist(command.ahead_mps, command.turn_radps, command.aside_mps)
        except ValueError as error:
            return str(error)
        sent_ns = min(command.stamp_ns or now_ns, now_ns)
        self._valid_until_ns = sent_ns + round(self._base.patience_s(self._fastest_mps()) * 1e9)
        return ""

    def _fastest_mps(self) -> float:
        """Commanded speed of the fastest wheel."""
        return min(max(abs(speed) for speed in self._wanted), self._base.max_wheel_speed_mps)

    def set_latch(self, state: LatchState) -> None:
        """Latched and unknown stop the wheels; a release does not revive an earlier command. Thread-safe."""
        self.latch = state
        self._valid_until_ns = -1

    def wheels(self, now_ns: int, dt_s: float) -> tuple[float, ...]:
        """Advance the ramp by one step. Returns the speeds to drive the wheels at, m/s."""
        self.ramp.advance(self._allowed_mps(now_ns), dt_s)
        return self.ramp.wheels_mps

    def strained(self, torques_nm: Sequence[float]) -> None:
        """Take the torques of the wheels' motors in the step that ended now; `rolled` follows."""

    def rolled(self, rolled_m: Sequence[float], now_ns: int, dt_s: float) -> None:
        """Take what the wheels' encoders measured in the step that ended now."""
        if self._exact:
            self.odometry.advance(rolled_m, dt_s)
            return
        self._counters.roll(rolled_m)
        self.odometry.advance([speed_mps * dt_s for speed_mps in self.ramp.wheels_mps], dt_s)
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
            aside_mps=odometry.aside_mps,
            bump_left=self.bumper.left,
            bump_right=self.bumper.right,
            latch=self.latch,
            stopped_by=self.stopped_by,
        )

    def _allowed_mps(self, now_ns: int) -> tuple[float, ...]:
        """The part of the commanded speeds that deadman, emergency stop and bump reflex allow."""
        self.stopped_by = ""
        if self.latch != "released":
            self.stopped_by = STOPPED_BY[self.latch]
            return self._rest
        if now_ns > self._valid_until_ns:
            self.stopped_by = "no command"
            return self._rest
        # A round base may still turn on the spot, and leave what it touches.
        in_front = self.bumper.pressed and self._asked.ahead > 0.0
        beside = self._touches(self._asked.aside)
        if not (in_front or beside):
            return self._wanted
        self.stopped_by = "bump"
        ahead, _, aside = self._drive.twist(self._wanted)
        into = Twist(ahead if in_front else 0.0, 0.0, aside if beside else 0.0)
        return tuple(wanted - part for wanted, part in zip(self._wanted, self._drive.wheels(into), strict=True))

    def _touches(self, aside: float) -> bool:
        """Whether a switch is pressed on the side to which it is to move."""
        return (self.bumper.left and aside > 0.0) or (self.bumper.right and aside < 0.0)
