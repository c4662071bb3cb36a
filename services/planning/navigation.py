"""Egocentric navigation: arcs that bring a target to a given position in the body frame.

The paper's arc to a target at planar (rho, phi) has radius R = rho / (2 sin phi) (derived). Here the target is not
to end under the robot's centre but on a line parallel to its heading, `aim_m` = (x, y) in the body frame, since the arm
reaches along y = -0.10. A robot that drives straight with the target at bearing phi_aim = asin(y / rho) ends there; so
phi is replaced by the bearing error phi - phi_aim, and rho by the distance still to drive.
"""

from __future__ import annotations

from math import asin, atan2, copysign, hypot, sin, sqrt
from typing import NamedTuple

from cocoro.base import Base
from cocoro.differential import Differential
from cocoro.drive import Twist, WheelDrive
from cocoro.frames import Pose2, wrap_rad
from cocoro.messages import BaseCommand
from services.planning.config import NavigationConfig

PREVIEW_S = 0.1
"""Time between two poses of a previewed drive, s."""
_REACTION_S = 0.25
"""Time that passes at full speed before the robot brakes."""
_BRAKING_SHARE = 0.6
"""Way of braking as a share of speed squared by acceleration: the half, and a fifth more."""

GENTLE = 0.5
"""Share of the limits for a way that needs care more than speed: round something, with something in the hand, or where
the scans on the way correct the body's pose."""
_COAST_S = 0.04
"""Time between a command and the pose that shows it."""


class Offset(NamedTuple):
    """The rest of a drive."""

    ahead_m: float
    """Distance to drive; negative when the target is too near."""
    heading_rad: float
    """Angle to turn, counter-clockwise positive."""


def offset_to(target_m: tuple[float, float], aim_m: tuple[float, float]) -> Offset:
    """The rest of a drive from the target's position and its wanted position, both (x, y), body frame."""
    x, y = target_m
    rho = max(hypot(x, y), abs(aim_m[1]) + 1e-3)
    aim_bearing = asin(aim_m[1] / rho)
    heading = wrap_rad(atan2(y, x) - aim_bearing)
    return Offset(sqrt(rho * rho - aim_m[1] ** 2) - aim_m[0], heading)


class Driver:
    """Converts the rest of a drive into commands, with bounded acceleration."""

    def __init__(self, config: NavigationConfig, base: Base) -> None:
        self._config = config
        self._base = base
        self._drive = base.drive
        self._turns_with: WheelDrive = self._drive
        self._speed_mps = 0.0
        self._turn_radps = 0.0
        self._aside_mps = 0.0

    def turn_with(self, separation_m: float | None) -> None:
        """Use a learned distance of the two wheels of a differential base; None is the nominal one."""
        self._turns_with = self._drive if separation_m is None else Differential(separation_m)

    def reset(self) -> None:
        self._speed_mps = self._turn_radps = self._aside_mps = 0.0

    @property
    def moving(self) -> bool:
        return max(abs(self._speed_mps), abs(self._turn_radps), abs(self._aside_mps)) > 1e-3

    @property
    def coast_m(self) -> float:
        """The way that the robot still drives when it brakes now."""
        speed = abs(self._speed_mps)
        return speed**2 / (2 * self._config.acceleration_mps2) + _COAST_S * speed

    def arrived(self, offset: Offset) -> bool:
        config = self._config
        return (
            abs(offset.ahead_m) <= config.distance_tolerance_m
            and abs(offset.heading_rad) <= config.heading_tolerance_rad
        )

    def law(self, offset: Offset) -> tuple[float, float]:
        """Speed and turn rate of the arc for the rest of the drive, before the acceleration limits."""
        config = self._config
        ahead, heading = offset.ahead_m, offset.heading_rad
        if abs(ahead) <= config.distance_tolerance_m:
            speed = 0.0
        else:
            # Slow enough to brake within the remaining distance.
            speed = sqrt(abs(ahead) * config.acceleration_mps2 / _BRAKING_SHARE)
            speed = copysign(min(config.max_speed_mps, speed), ahead)
        if abs(heading) > config.turn_in_place_rad:
            speed = 0.0
        elif ahead > 0:
            speed *= max(0.0, 1.0 - abs(heading) / config.turn_in_place_rad)
        arc = 2.0 * speed * sin(heading) / max(abs(ahead), 0.15) if ahead > 0 else 0.0
        align = config.turn_gain_per_s * heading if abs(heading) > config.heading_tolerance_rad / 2 else 0.0
        turn = arc if abs(arc) > abs(align) else align
        return speed, min(max(turn, -config.max_turn_radps), config.max_turn_radps)

    def preview(self, target_m: tuple[float, float], aim_m: tuple[float, float], for_s: float = 20.0) -> list[Pose2]:
        """The poses along the arc in the present body frame, every `PREVIEW_S` for at most so long."""
        poses = [Pose2()]
        for _ in range(round(for_s / PREVIEW_S)):
            x, y, _z = poses[-1].inverse().apply((*target_m, 0.0))
            offset = offset_to((x, y), aim_m)
            if self.arrived(offset):
                break
            speed, turn = self.law(offset)
            poses.append(poses[-1].compose(Pose2(speed * PREVIEW_S, 0.0, turn * PREVIEW_S)))
        return poses

    def stopping_poses(self, speed_mps: float, turn_radps: float, *, turning: bool = False) -> list[Pose2]:
        """The poses, in the present body frame, while the robot reacts and stops; with `turning` until a gentle turn
        has ended, too."""
        time_s = _REACTION_S + _BRAKING_SHARE * abs(speed_mps) / self._config.acceleration_mps2
        if turning:
            turn_s = _BRAKING_SHARE * abs(turn_radps) / (GENTLE * self._config.turn_acceleration_radps2)
            time_s = max(time_s, _REACTION_S + turn_s)
        steps = max(2, round(time_s / 0.08))
        poses = [Pose2()]
        for _ in range(steps):
            poses.append(poses[-1].compose(Pose2(speed_mps * time_s / steps, 0.0, turn_radps * time_s / steps)))
        return poses[1:]

    def stopping_mps(self, way_m: float) -> float:
        """The greatest speed from which the robot reacts and stops within a way, m: `stopping_poses` end there."""
        braking = _BRAKING_SHARE / self._config.acceleration_mps2
        return (sqrt(_REACTION_S**2 + 4 * braking * max(way_m, 0.0)) - _REACTION_S) / (2 * braking)

    def command(
        self, speed_mps: float, turn_radps: float, dt_s: float, *, pace: float = 1.0, aside_mps: float = 0.0
    ) -> BaseCommand:
        """Approach a speed, turn rate and speed aside within the acceleration limits. `pace` is the share of the limits
        that is used to go faster and to turn; to go slower, all of them are. When a wheel saturates, all wheels are
        scaled, which keeps the arc."""
        config = self._config
        self._speed_mps = self._nearer(self._speed_mps, speed_mps, dt_s, pace)
        self._aside_mps = self._nearer(self._aside_mps, aside_mps, dt_s, pace)
        limit = pace * config.max_turn_radps
        turn_radps = min(max(turn_radps, -limit), limit)
        self._turn_radps = _approach(self._turn_radps, turn_radps, pace * config.turn_acceleration_radps2 * dt_s)
        wheels_mps = self._turns_with.wheels(self._twist)
        excess = max(abs(speed_mps) for speed_mps in wheels_mps) / self._base.max_wheel_speed_mps
        if excess > 1.0:
            wheels_mps = tuple(speed_mps / excess for speed_mps in wheels_mps)
        return self._drive.command_of(wheels_mps)

    def within(self, command: BaseCommand, limit_mps: float) -> BaseCommand:
        """Scale a command on its arc until no wheel exceeds a limit; the next command continues from there."""
        fastest_mps = self._drive.fastest_mps(command)
        if fastest_mps <= limit_mps:
            return command
        share = limit_mps / fastest_mps
        self._scale(share)
        return BaseCommand(
            ahead_mps=share * command.ahead_mps,
            turn_radps=share * command.turn_radps,
            aside_mps=share * command.aside_mps,
        )

    def pause(self, dt_s: float) -> BaseCommand:
        """A zero command while a publisher is late. The next command continues from the speed that the base's own
        ramp has left."""
        fastest_mps = self._turns_with.fastest(self._twist)
        rest_mps = max(fastest_mps - self._base.wheel_acceleration_mps2 * dt_s, 0.0)
        share = rest_mps / fastest_mps if fastest_mps > 0.0 else 0.0
        self._scale(share)
        return BaseCommand(ahead_mps=0.0, turn_radps=0.0)

    def halt(self) -> BaseCommand:
        """A zero command without a ramp of the planner; the base's own ramp remains."""
        self.reset()
        return BaseCommand(ahead_mps=0.0, turn_radps=0.0)

    def brake(self, dt_s: float) -> BaseCommand:
        return self.command(0.0, 0.0, dt_s)

    @property
    def _twist(self) -> Twist:
        return Twist(self._speed_mps, self._turn_radps, self._aside_mps)

    def _nearer(self, now_mps: float, wanted_mps: float, dt_s: float, pace: float) -> float:
        faster = abs(wanted_mps) > abs(now_mps) and wanted_mps * now_mps >= 0
        most_mps2 = self._config.acceleration_mps2 * (pace if faster else 1.0)
        return _approach(now_mps, wanted_mps, most_mps2 * dt_s)

    def _scale(self, share: float) -> None:
        self._speed_mps *= share
        self._turn_radps *= share
        self._aside_mps *= share


def _approach(value: float, goal: float, step: float) -> float:
    return goal if abs(goal - value) <= step else value + copysign(step, goal - value)
