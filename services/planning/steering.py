"""Arm, head and claws as an operator's hand wants them: rates, within the limits, that end with his input."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cocoro.clock import NS
from cocoro.messages import Motion
from services.planning.arm import ArmStep
from services.planning.caution import limited
from services.planning.course import Course
from services.planning.head import Aim
from services.planning.reach import HandPose

if TYPE_CHECKING:
    from services.planning.behaviours.base import Snapshot
    from services.planning.surroundings import Fields

_THERE_M = 0.03
"""Rest of the way at which the arm counts as unfolded."""
_CATCH_UP = 1.25
"""Speed of a head that follows its goal, as a share of the goal's greatest."""


class SteeredHand:
    """Moves the hand in its own cylindrical coordinates: out, round, up, and the wrist's roll. A folded arm is unfolded
    first, for as long as the operator wants the hand to move."""

    def __init__(self) -> None:
        self._goal: HandPose | None = None
        self._roll_rad = 0.0
        self._unfolding = False
        self._glance_since_ns: int | None = None
        self.why = ""
        """What the arm does or why it does not; '' at rest."""
        self.look_at: tuple[float, float] | None = None
        """Floor under the unfolding arm that was not seen yet, odometry frame, m."""

    def step(self, snapshot: Snapshot, motion: Motion, fields: Fields) -> ArmStep:
        actuators = snapshot.actuators
        arm, angles = actuators.arm, snapshot.angles
        self.why, self.look_at = "", None
        if not motion.hand:
            self._goal = None
            return arm.hold(angles, snapshot.dt_s)
        if arm.stalled:
            self._goal = None
            arm.resync()
            self.why = "something holds the arm up"
            return arm.hold(angles, snapshot.dt_s)
        reference = arm.reference or angles
        self._unfolding |= arm.folded(reference)
        if self._unfolding:
            return self._unfold(snapshot, fields)
        self.why = "moving the hand"
        have, roll_rad = actuators.reacher.pose({**angles, **reference}), reference[actuators.robot.arm.roll]
        step = self._steer(snapshot, motion, have, roll_rad)
        if step.blocked:
            self._goal = None
            self.why = "the hand cannot go there: the robot or the floor is in its way"
        return step

    @property
    def unfolding(self) -> bool:
        """Whether the arm is on its way to the front, which the base waits for."""
        return self._unfolding

    def _unfold(self, snapshot: Snapshot, fields: Fields) -> ArmStep:
        actuators, config = snapshot.actuators, snapshot.actuators.config
        arm, angles, dt_s = actuators.arm, snapshot.angles, snapshot.dt_s
        if arm.parked(arm.reference or angles):
            watcher = Course(actuators.robot, config, (0.0, 0.0), arm="folded", swing_m=actuators.unfolding)
            if not watcher.roomy(snapshot.body, fields):
                self.why = "no room here to unfold the arm"
                return arm.hold(angles, dt_s)
            if (place := self._unseen_swing(snapshot)) is not None:
                self.why, self.look_at = "looking where to unfold the arm", place
                return arm.hold(angles, dt_s)
        travel = config.arm
        goal = HandPose(travel.travel_radius_m, 0.0, travel.travel_height_m, travel.pitch_rad)
        step = arm.reach(goal, travel.hand_speed_mps, angles, dt_s)
        self.why = "the arm's way to the front is blocked" if step.blocked else "unfolding the arm"
        if step.arrived or (step.left < _THERE_M and not arm.folded(arm.reference or angles)):
            self._unfolding = False
        return step

    def _unseen_swing(self, snapshot: Snapshot) -> tuple[float, float] | None:
        """A place to look at before the arm unfolds, odometry frame, m; for the time of one glance."""
        if self._glance_since_ns is None:
            self._glance_since_ns = snapshot.now_ns
        glance_s = snapshot.actuators.config.navigation.glance_s + snapshot.estimator.sight_lag_s
        if not 0 <= snapshot.now_ns - self._glance_since_ns <= glance_s * NS:
            return None
        return snapshot.unseen_under_swing()

    def _steer(self, snapshot: Snapshot, motion: Motion, have: HandPose, roll_rad: float) -> ArmStep:
        """One step of the hand at the wanted rates. The goal keeps what is not to change, and stays near the hand."""
        actuators, config = snapshot.actuators, snapshot.actuators.config.by_hand
        dt_s = snapshot.dt_s
        if self._goal is None:
            self._goal, self._roll_rad = have, roll_rad
        lead_m, lead_rad = config.lead_m, config.lead_rad
        goal = self._goal
        radius_m = goal.radius_m + limited(motion.out_mps, config.hand_mps) * dt_s
        azimuth_rad = goal.azimuth_rad + limited(motion.round_radps, config.hand_radps) * dt_s
        height_m = goal.height_m + limited(motion.up_mps, config.hand_mps) * dt_s
        self._goal = goal = HandPose(
            _near(_within(radius_m, config.radius_m, have.radius_m), have.radius_m, lead_m),
            _near(_within(azimuth_rad, config.azimuth_rad, have.azimuth_rad), have.azimuth_rad, lead_rad),
            _near(_within(height_m, config.height_m, have.height_m), have.height_m, lead_m),
            goal.pitch_rad,
        )
        low, high = actuators.robot.joints[actuators.robot.arm.roll].limits_rad
        roll = self._roll_rad + limited(motion.roll_radps, config.roll_radps) * dt_s
        self._roll_rad = _near(min(max(roll, low), high), roll_rad, config.head_lead_rad)
        return actuators.arm.reach(
            goal, actuators.config.arm.hand_speed_mps, snapshot.angles, dt_s, roll_rad=self._roll_rad
        )


class SteeredHead:
    """Turns the head at the wanted rates; without, it looks where it is told to."""

    def __init__(self) -> None:
        self._goal: tuple[float, float] | None = None
        self._used_ns: int | None = None

    def free(self, snapshot: Snapshot) -> bool:
        """Whether the operator has left a head alone for a while, so that it looks where it is told to."""
        if not snapshot.actuators.gaze.joints:
            return False  # the operator turns the base
        wait_ns = snapshot.actuators.config.by_hand.look_after_s * NS
        return self._used_ns is None or not 0 <= snapshot.now_ns - self._used_ns <= wait_ns

    def step(self, snapshot: Snapshot, motion: Motion, look_at: tuple[float, float] | None) -> Aim | None:
        """What the neck turns the camera to; None leaves it at its goal."""
        actuators, config = snapshot.actuators, snapshot.actuators.config.by_hand
        here, limits = snapshot.looks_rad, actuators.gaze.limits_rad
        if motion.head:
            self._used_ns = snapshot.now_ns
            start = self._goal or here
            rates = (limited(rate, config.head_radps) for rate in (motion.pan_radps, motion.tilt_radps))
            wanted = (angle + rate * snapshot.dt_s for angle, rate in zip(start, rates, strict=True))
            pan, tilt = (
                _near(_within(angle, limit, at), at, config.head_lead_rad)
                for angle, limit, at in zip(wanted, limits, here, strict=True)
            )
            self._goal = pan, tilt
            return Aim(pan, tilt, _CATCH_UP * config.head_radps)
        if self._goal is not None:
            self._goal = None
            return Aim(*here, config.head_radps)
        if look_at is not None and self.free(snapshot):
            return snapshot.look_at(snapshot.body.inverse().apply((*look_at, 0.0)))
        return None


class SteeredGrip:
    """Opens and closes the claws. What was begun is completed; closed claws that hold something clamp it."""

    def __init__(self) -> None:
        self._asked = ""
        self._closing_since_ns: int | None = None

    def step(self, snapshot: Snapshot, motion: Motion) -> None:
        grip, hand = snapshot.actuators.grip, snapshot.estimator.hand
        if motion.grip != self._asked:
            self._asked = motion.grip
            if motion.grip == "open":
                self._closing_since_ns = None
                grip.open()
            elif motion.grip == "close" and not snapshot.holding:
                self._closing_since_ns = snapshot.now_ns
                grip.close()
        if self._closing_since_ns is None or hand is None:
            return
        if snapshot.holding:
            grip.clamp(hand)
            self._closing_since_ns = None
        elif snapshot.now_ns - self._closing_since_ns > snapshot.actuators.config.hand.give_up_s * NS:
            self._closing_since_ns = None


def _within(value: float, limits: tuple[float, float], here: float) -> float:
    """A value within its limits; where it is beyond them already it may only come back."""
    low, high = min(limits[0], here), max(limits[1], here)
    return min(max(value, low), high)


def _near(value: float, here: float, lead: float) -> float:
    """A value at most so far from where it is."""
    return min(max(value, here - lead), here + lead)
