"""The simulated servos: positions in counts, limits of speed and torque, expiry of commands, overload.

Pure. At every step the world passes the time, the joint's true angle and the motor's torque to each `SimServo`, and
asks it what its motor does. This module does not know the physics engine.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import degrees, radians
from typing import NamedTuple

from cocoro.joints import Joint
from cocoro.messages import LatchState, ServoCommand, ServoState
from cocoro.messages.hardware import STOPPED_BY

AT_GOAL_RAD = radians(0.59)
"""A joint this close to its goal, two counts of an AX-12, has arrived: it is not stopped when its command expires."""
PUNCH = 0.1
"""Least share of its torque limit with which a compliant servo pushes."""
OVERLOAD_SHARE = 0.98
HOLD_SPEED_RADPS = 1.0
TEMPERATURE_C = 38.0
VOLTAGE_V = 12.0


class Drive(NamedTuple):
    """The target of a joint's motor."""

    target_rad: float
    max_speed_radps: float
    max_torque_nm: float


class Backlash:
    """Backlash: the measured shaft follows the joint only when the joint pushes it.

    The play (hysteresis) operator; with `width_rad` 0 both angles are equal.
    """

    def __init__(self, width_rad: float, angle_rad: float = 0.0) -> None:
        self._half_rad = width_rad / 2
        self.shaft_rad = angle_rad

    def follow(self, angle_rad: float) -> float:
        """Move the joint to `angle_rad`; returns the shaft's angle."""
        half = self._half_rad
        if self.shaft_rad < angle_rad - half:
            self.shaft_rad = angle_rad - half
        if self.shaft_rad > angle_rad + half:
            self.shaft_rad = angle_rad + half
        return self.shaft_rad


class SimServo:
    """One servo: its command, its measurements and its motor."""

    def __init__(self, joint: Joint, angle_rad: float, backlash_rad: float = 0.0) -> None:
        self.joint = joint
        self.goal_count = joint.to_count(angle_rad)
        self._goal = self.goal_count, joint.to_angle(self.goal_count)
        """The goal in counts and in rad, since the drive is asked for at every step and the goal changes seldom."""
        self.speed_limit_radps = HOLD_SPEED_RADPS
        self.overloaded = False
        self._play = Backlash(backlash_rad, angle_rad)
        self.angle_rad = angle_rad
        """True angle of the joint."""
        self.slip_rad = 0.0
        """How far the joint's angle exceeds the shaft's because it has slipped."""
        self._speed_radps = 0.0
        self._torque_nm = 0.0
        self._strain_nm = OVERLOAD_SHARE * joint.torque_nm
        """Torque from which on the servo strains."""
        self._valid_until_ns: int | None = None
        self._straining_since_ns: int | None = None

    @property
    def count(self) -> int:
        """Present position, counts."""
        return self.joint.to_count(self._play.shaft_rad)

    @property
    def position_rad(self) -> float:
        return self.joint.to_angle(self.count)

    @property
    def speed_radps(self) -> float:
        unit = self.joint.units.speed_radps
        return round(self._speed_radps / unit) * unit

    @property
    def load(self) -> float:
        """Share of the stall torque, -1 to 1."""
        share = self._torque_nm / self.joint.torque_nm
        full = self.joint.units.full_torque
        return round(min(max(share, -1.0), 1.0) * full) / full

    def command(self, goal_rad: float, speed_radps: float, until_ns: int) -> None:
        """Go to a goal within the joint's limits; a speed of 0 holds where the joint is."""
        self._valid_until_ns = until_ns
        if speed_radps == 0.0:
            self._hold_here()
            return
        low, high = self.joint.limits_rad
        self.goal_count = self.joint.to_count(min(max(goal_rad, low), high))
        unit = self.joint.units.speed_radps
        self.speed_limit_radps = min(max(1, round(speed_radps / unit)) * unit, self.joint.max_speed_radps)

    @property
    def commanded(self) -> bool:
        """Whether there is a command that has not expired."""
        return self._valid_until_ns is not None

    def hold(self) -> None:
        """Drop the command and stay at the present position."""
        self._valid_until_ns = None
        self._hold_here()

    def expire(self, now_ns: int) -> bool:
        """Hold the joint where it is when the last command has expired before the joint arrived. Returns whether it
        had."""
        if self._valid_until_ns is None or now_ns <= self._valid_until_ns:
            return False
        self._valid_until_ns = None
        if abs(self.goal_count - self.count) * self.joint.units.count_rad <= AT_GOAL_RAD:
            return False
        self._hold_here()
        return True

    def sense(self, angle_rad: float, speed_radps: float, torque_nm: float, now_ns: int) -> None:
        """Take what the joint did in the step that ended now."""
        self.angle_rad = angle_rad
        self._speed_radps = speed_radps
        self._torque_nm = torque_nm
        self._play.follow(angle_rad - self.slip_rad)
        if -self._strain_nm < torque_nm < self._strain_nm:
            self._straining_since_ns = None
        elif self._straining_since_ns is None:
            self._straining_since_ns = now_ns
        elif now_ns - self._straining_since_ns > self.joint.overload_s * 1e9:
            self.overloaded = True

    def drive(self, speed_factor: float = 1.0) -> Drive:
        """The motor's target. The servo closes its loop on the measured shaft, so the joint stops up to half the
        backlash beside the goal."""
        joint = self.joint
        if self.goal_count != self._goal[0]:
            self._goal = self.goal_count, joint.to_angle(self.goal_count)
        error_rad = self._goal[1] - self._play.shaft_rad
        torque_nm = joint.torque_nm
        if joint.compliance_deg:
            share = abs(degrees(error_rad)) / joint.compliance_deg
            torque_nm *= min(max(share, PUNCH), 1.0)
        speed_radps = self.speed_limit_radps * speed_factor
        if speed_radps > joint.max_speed_radps:
            speed_radps = joint.max_speed_radps
        return Drive(self.angle_rad + error_rad, speed_radps, torque_nm)

    def _hold_here(self) -> None:
        self.goal_count = self.count


class SimServoGroup:
    """The servos of one group: commands, states, the emergency stop and the expiry of commands.

    A joint of arm or neck that is not commanded again within `timeout_s` holds where it is unless it has arrived. With
    `keeps_goal` (the hand) joints keep their goals, also during an emergency stop, so that a held object stays held.
    """

    def __init__(
        self,
        joints: Mapping[str, Joint],
        angles_rad: Mapping[str, float],
        *,
        keeps_goal: bool,
        timeout_s: float,
        backlash_deg: float = 0.0,
    ) -> None:
        self.servos = {name: SimServo(joint, angles_rad[name], radians(backlash_deg)) for name, joint in joints.items()}
        self.latch: LatchState = "released"
        self._keeps_goal = keeps_goal
        self._timeout_ns = round(timeout_s * 1e9)

    @property
    def stopped_by(self) -> str:
        return STOPPED_BY[self.latch]

    def command(self, command: ServoCommand, now_ns: int) -> str:
        """Accept all goals or none. Returns '' when accepted, otherwise the reason for refusing."""
        if self.stopped_by:
            return self.stopped_by
        if unknown := [name for name in command.joints if name not in self.servos]:
            return f"no joint {unknown[0]!r} in this group, which has {', '.join(self.servos)}"
        for name, goal_rad, speed_radps in zip(command.joints, command.goal_rad, command.speed_radps, strict=True):
            self.servos[name].command(goal_rad, speed_radps, now_ns + self._timeout_ns)
        return ""

    def set_latch(self, state: LatchState) -> None:
        """Latched and unknown hold the arm and neck where they are; a reset from latched clears the overloads."""
        if state != "released" and self.latch == "released" and not self._keeps_goal:
            for servo in self.servos.values():
                servo.hold()
        if state == "released" and self.latch == "latched":
            for servo in self.servos.values():
                servo.overloaded = False
        self.latch = state

    def expire(self, now_ns: int) -> None:
        """Hold the joints whose commands have expired, or all during an emergency stop. Call it at every step: a stop
        may come from another thread while a command is being accepted."""
        if not self._keeps_goal:
            stopped = self.latch != "released"
            for servo in self.servos.values():
                if stopped and servo.commanded:
                    servo.hold()
                servo.expire(now_ns)

    def state(self, now_ns: int) -> ServoState:
        servos = self.servos.values()
        return ServoState(
            stamp_ns=now_ns,
            joints=tuple(self.servos),
            position_rad=tuple(servo.position_rad for servo in servos),
            speed_radps=tuple(servo.speed_radps for servo in servos),
            load=tuple(servo.load for servo in servos),
            temperature_c=(TEMPERATURE_C,) * len(servos),
            voltage_v=(VOLTAGE_V,) * len(servos),
            torque_enabled=(True,) * len(servos),
            faults=tuple(f"{name}: overload" for name, servo in self.servos.items() if servo.overloaded),
            latch=self.latch,
            stopped_by=self.stopped_by,
        )
