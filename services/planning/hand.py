"""The claws, moved together as one degree of freedom, whether they hold something, and where the hand goes for it."""

from __future__ import annotations

from math import cos, sin

import numpy as np

from cocoro.messages import ServoCommand, ServoState
from cocoro.robot import Robot
from services.planning.config import HandConfig

MOST_ROOM_M = 0.015
"""A jaw that pushes a thing over by more may tip it or push it out of the hand."""


def aside_m(robot: Robot, width_m: float, room_m: float) -> float:
    """How far to the left of a thing's centre, m, the axis of a level hand goes that closes on it. Two jaws close about
    their middle. A fixed finger goes half of the thing's width and some room beside its centre; the jaw then moves the
    thing over."""
    if robot.claw.fixed_pad_m is None:
        return 0.0
    level = dict.fromkeys(robot.joints, 0.0) | robot.poses["upright"] | {robot.arm.roll: robot.claw.level_roll_rad}
    jaw, hand = (robot.chain(link).pose(level) for link in (robot.link_of(robot.jaws[0]), robot.arm.tip))
    along = hand[:3, 2]
    left = np.array([-along[1], along[0], 0.0]) / max(float(np.hypot(along[0], along[1])), 1e-6)
    return float((robot.claw.fixed_pad_m - width_m / 2 - room_m) * (jaw[:3, 0] @ left))


def gap_m(robot: Robot, opening_rad: float) -> float:
    """Distance of the pads' middles, m, with every jaw opened so far."""
    return robot.claw.pad_gap_m + sum(_levers_m(robot)) * sin(opening_rad)


def finger_m(robot: Robot, opening_rad: float) -> float:
    """Distance, m, of the outer side of an open jaw's end from the hand's middle: the axis between two jaws, or the
    middle of a thing as wide as `claw.pad_gap_m` that touches the fixed finger."""
    claw, lever_m = robot.claw, max(_levers_m(robot))
    out_m = (lever_m + claw.pad_length_m / 2) * sin(opening_rad) + claw.pad_thickness_m * cos(opening_rad)
    return claw.pad_gap_m / 2 + out_m


def _levers_m(robot: Robot) -> list[float]:
    """For each jaw the distance, m, along the hand from the axis that it turns about to the pads' middle."""
    zero = dict.fromkeys(robot.joints, 0.0)
    tip = robot.chain(robot.arm.tip).pose(zero)
    return [abs(float((np.linalg.inv(robot.chain(robot.link_of(jaw)).pose(zero)) @ tip)[1, 3])) for jaw in robot.jaws]


def side_room_m(robot: Robot, config: HandConfig, width_m: float) -> float:
    """What a fixed finger leaves, m, between itself and a thing of this width as the hand closes in: as much as the
    open jaw leaves on the other side, but the jaw does not push the thing further than `MOST_ROOM_M`. 0 with two
    jaws."""
    if robot.claw.fixed_pad_m is None:
        return 0.0
    half_m = (gap_m(robot, config.open_rad) - width_m) / 2
    return max(min(half_m, MOST_ROOM_M), config.fixed_finger_room_m)


def widest_m(robot: Robot, config: HandConfig) -> float:
    """Greatest width, m, of a thing that the open hand goes around, the room beside a fixed finger taken off."""
    width_m = gap_m(robot, config.open_rad)
    return width_m if robot.claw.fixed_pad_m is None else width_m - config.fixed_finger_room_m


class Grip:
    """Commands the claws by their opening angles and detects by their load whether they hold something.

    Closing goes past contact at full torque. When an object has stopped the claws, `clamp` sets each claw's goal a
    fixed angle past the contact: within the servos' compliance slope the torques then balance, and the object stays
    where it was grasped instead of drifting with the pair.
    """

    def __init__(self, robot: Robot, config: HandConfig) -> None:
        self._config = config
        self._opens = robot.claw.open_sign
        self._jaws = robot.jaws
        self._roll = robot.arm.roll
        self._goals: dict[str, float] | None = None
        self._clamped: dict[str, float] | None = None
        """Goals that clamp an object."""
        self._held_since_ns: int | None = None

    def open(self) -> None:
        self._goals = dict.fromkeys(self._jaws, self._config.open_rad)

    def close(self) -> None:
        self._goals = dict.fromkeys(self._jaws, -self._config.close_rad)

    def aim(self, opening_rad: float) -> None:
        """Open or close so far, by the angle of each claw, within the range of `open` and `close`."""
        wanted_rad = min(max(opening_rad, -self._config.close_rad), self._config.open_rad)
        self._goals = dict.fromkeys(self._jaws, wanted_rad)

    def clamp(self, hand: ServoState) -> None:
        """Hold the object that has stopped the claws."""
        self._goals = {
            name: angle - self._config.clamp_rad for name, angle in zip(self._jaws, self.opening(hand), strict=True)
        }
        self._clamped = self._goals

    def halt(self, hand: ServoState) -> None:
        """Stop claws that open or close; those that have met an object clamp it. Claws that clamp already do nothing
        else, so that nothing is dropped."""
        opening, closing = self._config.open_rad, -self._config.close_rad
        if self._goals == dict.fromkeys(self._jaws, closing) and self._pressed(hand):
            self.clamp(hand)
        elif self._goals in (dict.fromkeys(self._jaws, opening), dict.fromkeys(self._jaws, closing)):
            self._goals = dict(zip(self._jaws, self.opening(hand), strict=True))

    def keep(self) -> None:
        """Leave the claws as they are."""
        self._goals = None

    def command(self, roll_rad: float | None) -> ServoCommand:
        joints: list[str] = []
        goals: list[float] = []
        speeds: list[float] = []
        if roll_rad is not None:
            joints.append(self._roll)
            goals.append(roll_rad)
            speeds.append(2.5)
        for name, opening in (self._goals or {}).items():
            joints.append(name)
            goals.append(self._opens[name] * opening)
            speeds.append(self._config.speed_radps)
        return ServoCommand(joints=tuple(joints), goal_rad=tuple(goals), speed_radps=tuple(speeds))

    def opening(self, hand: ServoState) -> tuple[float, ...]:
        """The opening angle of each jaw, radians, from the measured positions."""
        place = dict(zip(hand.joints, hand.position_rad, strict=True))
        return tuple(self._opens[name] * place[name] for name in self._jaws)

    def opened(self, hand: ServoState) -> bool:
        return min(self.opening(hand)) > self._config.open_rad - 0.08

    def feel(self, hand: ServoState, now_ns: int) -> None:
        """Take a measurement: a grip counts once it has lasted `settle_s`."""
        self._press_on(hand)
        if self._pressed(hand) and sum(self.opening(hand)) > len(self._jaws) * (0.06 - self._config.close_rad):
            if self._held_since_ns is None:
                self._held_since_ns = now_ns
        else:
            self._held_since_ns = None

    def _press_on(self, hand: ServoState) -> None:
        """Let a single jaw that clamps go on with its thing. It may have stopped at one that still stood off the fixed
        finger, or that turned in the hand since; of a pair, one jaw that follows would push the other away."""
        if self._goals is None or self._goals != self._clamped or len(self._jaws) != 1:
            return
        (name,), (opening,) = self._jaws, self.opening(hand)
        goal = max(min(self._goals[name], opening - self._config.clamp_rad), -self._config.close_rad)
        self._goals = self._clamped = {name: goal}

    def holding(self, now_ns: int) -> bool:
        """Whether the claws have held something for `settle_s`."""
        return self._held_since_ns is not None and (now_ns - self._held_since_ns) / 1e9 >= self._config.settle_s

    @property
    def pressing(self) -> bool:
        """Whether the claws push against something at the newest measurement."""
        return self._held_since_ns is not None

    def _pressed(self, hand: ServoState) -> bool:
        """Whether all jaws push inwards without closing; two may swing together."""
        loads = dict(zip(hand.joints, hand.load, strict=True))
        speeds = dict(zip(hand.joints, hand.speed_radps, strict=True))
        pushing = all(-self._opens[name] * loads[name] >= self._config.grip_load for name in self._jaws)
        closing_radps = -sum(self._opens[name] * speeds[name] for name in self._jaws)
        return pushing and abs(closing_radps) < 0.3
