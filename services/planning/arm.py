"""The arm's trajectories: unfolding, folding, and moving the hand to a pose, one step at a time.

Between the parked pose and the space in front of the robot the arm passes one pose: unfolded in the plane that it parks
in, with the hand level. From there it swings to the front, so that it passes over obstacles. References are commanded
angles: feedback of the servos' coarse positions would add their steps to the motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.robot import Robot
from services.planning.clearance import Clearance
from services.planning.config import ArmConfig
from services.planning.reach import HandPose, Reacher

_SIDE_RAD = 0.6
"""Arm base angle beyond which the arm is in the plane that it parks in."""
_NEAR_RAD = 0.06
_LEAST_PACE_RADPS = 0.3
_HOLD_RADPS = 0.5
_SLOWEST_RADPS = 0.02
"""Of a joint that moves: 0 would hold it."""
_CAREFUL_S = 2.0
"""So long after a state was late, or a joint lagged, the next command or state may be late, too."""
_KEPT_S = 2.0
"""Longest silence after which the arm is still on its way: a service that died takes longer to come back."""
_SETTLED_RAD = 0.1
"""On a slow link the arm has arrived when its joints are so near to their goals. (They sag by less.)"""
_OUT_M = 0.02
"""So far out the hand goes at once where it cannot rise."""
_ASTRAY_RAD = 0.6
"""A pitch error above this occurs only after babbling."""


class ArmStep(NamedTuple):
    """Goals for the arm's joints (in their order) and for the hand's roll, with speeds."""

    goal_rad: FloatArray
    speed_radps: FloatArray
    roll_rad: float
    left: float
    """Remaining distance: metres for a hand pose, radians for joint angles."""
    arrived: bool
    blocked: bool = False


class ArmController:
    def __init__(self, robot: Robot, config: ArmConfig, reacher: Reacher) -> None:
        self._config = config
        self._reacher = reacher
        self.clearance = Clearance(robot)
        self._names, self._roll, self._azimuth = robot.arm.joints, robot.arm.roll, robot.arm.azimuth
        self._roll_rad = robot.claw.level_roll_rad
        self._park = {name: robot.poses["park"][name] for name in self._names}
        upright, self._bend = robot.poses["upright"], robot.arm.bend
        self._front_rad = upright[self._azimuth]
        self._straight_rad = robot.arm.straight_rad
        self._bend_sign = float(np.sign(upright[self._bend] - self._straight_rad))
        self._out = {name: robot.poses["unfolded"][name] for name in self._names[1:]}
        """Unfolded in the plane that the arm is in: the hand points away from the arm's foot, level."""
        self._reference: dict[str, float] | None = None
        self._stalled_s = 0.0
        self._lags = False
        """A joint is further behind its goal than `wait_rad`."""
        self._lagged_s = 0.0
        self._late_s = 0.0
        self._careful_s = 0.0
        """For so long the link still counts as slow."""
        self._pace_radps = _LEAST_PACE_RADPS
        """Speed of the fastest joint when the goals moved last: with it lagging joints catch up."""
        self._astray = False
        """The arm is where babbling left it: it returns by joint angles, not by a path of the hand."""
        self._clearance_m: float | None = None
        """Clearance of the reference, if it is known."""
        self._measured: FloatArray = np.zeros(len(robot.arm.joints))

    @property
    def reference(self) -> dict[str, float] | None:
        """The commanded angles of the arm's joints and the hand's roll, rad; None before the first measurement."""
        return self._reference

    def resync(self) -> None:
        """Start from the measured angles at the next step, because the arm was moved or stopped otherwise."""
        self._reference = None
        self._stalled_s = 0.0
        self._lagged_s = 0.0
        self._late_s = 0.0
        self._clearance_m = None

    def undelivered(self) -> None:
        """The commands do not arrive: the arm lags behind its goal, and nothing holds it up."""
        self._stalled_s = 0.0
        self._lagged_s = 0.0

    def late(self, dt_s: float) -> None:
        """The state is too old to move by. The arm goes on to its goal, or stops on its way there, so the goal stands;
        after `_KEPT_S` the arm may be anywhere."""
        if self._reference is None:
            return
        self._late_s += dt_s
        self._careful_s = _CAREFUL_S
        if self._late_s > _KEPT_S:
            self.resync()

    def folded(self, angles: Mapping[str, float]) -> bool:
        """Whether the arm is in or near the plane that it parks in."""
        return angles[self._azimuth] > _SIDE_RAD

    def parked(self, angles: Mapping[str, float]) -> bool:
        return all(abs(angles[name] - self._park[name]) < 0.08 for name in self._names)

    def hold(self, measured: Mapping[str, float], dt_s: float) -> ArmStep:
        reference = self._sync(measured, dt_s)
        goal = np.array([reference[name] for name in self._names])
        speed = self._together(goal, np.full(len(goal), _HOLD_RADPS))
        return ArmStep(goal, speed, reference[self._roll], 0.0, True)

    def park(self, measured: Mapping[str, float], dt_s: float) -> ArmStep:
        """One step of folding the arm beside the camera mount."""
        reference = self._sync(measured, dt_s)
        if not self.folded(reference):
            pose = self._reacher.pose(reference)
            astray = self._is_astray(reference, pose)
            out = all(abs(reference[name] - angle) < _NEAR_RAD for name, angle in self._out.items())
            if not out and pose.height_m < 0.15 and not astray:
                rise = HandPose(
                    max(pose.radius_m, self._config.travel_radius_m),
                    pose.azimuth_rad,
                    self._config.travel_height_m,
                    pose.pitch_rad,
                )
                step = self._cartesian(rise, self._config.hand_speed_mps, dt_s)
                if step.blocked:  # near the chassis the way up bends inwards
                    outwards = pose._replace(radius_m=pose.radius_m + _OUT_M)
                    step = self._cartesian(outwards, self._config.hand_speed_mps, dt_s)
                return step._replace(arrived=False)
            if not out or abs(reference[self._roll] - self._roll_rad) > _NEAR_RAD:
                return self._joints(self._out | {self._roll: self._roll_rad}, dt_s)._replace(arrived=False)
            return self._joints(self._out | {self._azimuth: self._park[self._azimuth]}, dt_s)._replace(arrived=False)
        self._astray = False
        if abs(reference[self._azimuth] - self._park[self._azimuth]) > _NEAR_RAD:
            return self._joints(self._out | {self._azimuth: self._park[self._azimuth]}, dt_s)._replace(arrived=False)
        return self._joints(self._park | {self._roll: 0.0}, dt_s)

    def reach(
        self,
        goal: HandPose,
        speed_mps: float,
        measured: Mapping[str, float],
        dt_s: float,
        *,
        swing_radps: float | None = None,
        roll_rad: float | None = None,
    ) -> ArmStep:
        """One step of the hand towards a pose in front of the robot; a folded arm is unfolded first. It swings to the
        front at `swing_radps` or, by default, as fast as it may. `roll_rad`: the wrist's at the pose; None: level."""
        reference = self._sync(measured, dt_s)
        stage: dict[str, float] | None = None
        if self.folded(reference):
            out = all(abs(reference[name] - angle) < _NEAR_RAD for name, angle in self._out.items())
            in_park_plane = reference[self._azimuth] > self._park[self._azimuth] - 0.2
            if not out and in_park_plane:
                stage = self._out | {self._roll: self._roll_rad}
            else:
                stage = self._out | {self._azimuth: self._front_rad, self._roll: self._roll_rad}
        elif reference[self._azimuth] > 0.35 and goal.azimuth_rad < 0.3:
            stage = self._out | {self._azimuth: self._front_rad, self._roll: self._roll_rad}
        elif self._is_astray(reference, self._reacher.pose(reference)):
            stage = self._out | {self._azimuth: self._front_rad, self._roll: self._roll_rad}
            self._astray = any(abs(reference[name] - angle) > _NEAR_RAD for name, angle in stage.items())
        if stage is None:
            return self._cartesian(goal, speed_mps, dt_s, roll_rad)
        left_m = float(np.linalg.norm(self._reacher.point(goal) - self._reacher.position(reference)))
        return self._joints(stage, dt_s, swing_radps if self._azimuth in stage else None)._replace(
            arrived=False, left=left_m
        )

    def towards(
        self, goals: Mapping[str, float], speed_radps: float, measured: Mapping[str, float], dt_s: float
    ) -> ArmStep:
        """One step of the named joints together to their goals (rad), straight in joint space."""
        self._astray = True
        self._sync(measured, dt_s)
        return self._joints(goals, dt_s, speed_radps)

    def _is_astray(self, reference: Mapping[str, float], pose: HandPose) -> bool:
        bent_back = self._bend_sign * (reference[self._bend] - self._straight_rad) < -_NEAR_RAD
        self._astray |= abs(pose.pitch_rad - self._config.pitch_rad) > _ASTRAY_RAD or bent_back
        return self._astray

    @property
    def stalled(self) -> bool:
        """Whether a joint has lagged behind its goal for `stall_s` while commands arrived."""
        return self._stalled_s > self._config.stall_s

    def _sync(self, measured: Mapping[str, float], dt_s: float) -> dict[str, float]:
        names = (*self._names, self._roll)
        if self._reference is None:
            self._reference = {name: measured[name] for name in names}
        leads = {name: self._reference[name] - measured[name] for name in names}
        self._lags = any(abs(leads[name]) > self._config.wait_rad for name in self._names)
        self._lagged_s = self._lagged_s + dt_s if self._lags else 0.0
        self._careful_s = _CAREFUL_S if self._lags else max(self._careful_s - dt_s, 0.0)
        self._late_s = 0.0
        behind = {name: lead for name, lead in leads.items() if abs(lead) > self._config.lead_rad}
        self._stalled_s = self._stalled_s + dt_s if behind else 0.0
        if behind and not self._waits:
            self._clearance_m = None
            for name, lead in behind.items():
                self._reference[name] = measured[name] + float(np.sign(lead)) * self._config.lead_rad
        self._measured = np.array([measured[name] for name in self._names])
        return self._reference

    @property
    def _waits(self) -> bool:
        """Whether the goal stands until the joints are nearer to it. Commands or states are late then, and a joint that
        lags alone would bring the hand off its way, down to the floor. What holds a joint up for longer is no delay."""
        return self._lags and self._careful

    @property
    def _careful(self) -> bool:
        """Whether joints may be far behind their goals because commands or states are late."""
        return self._careful_s > 0.0 and self._lagged_s < self._config.wait_s

    def _together(self, goal: FloatArray, speed_radps: FloatArray) -> FloatArray:
        """Speeds, rad/s, for goals, rad, both (n,). On a slow link all joints arrive at once, so that the hand stays on
        its way, however far ahead the goals are."""
        if self._careful_s <= 0.0:
            return speed_radps
        gaps: FloatArray = np.abs(goal - self._measured)
        together: FloatArray = np.maximum(gaps * (speed_radps.max() / max(gaps.max(), 1e-6)), _SLOWEST_RADPS)
        return together

    def _joints(self, goals: Mapping[str, float], dt_s: float, speed_radps: float | None = None) -> ArmStep:
        """One step of the named joints to their goals; the others stay."""
        assert self._reference is not None
        gaps = {name: goal - self._reference[name] for name, goal in goals.items()}
        widest = max(abs(gap) for gap in gaps.values())
        step_rad = (speed_radps or self._config.joint_speed_radps) * dt_s
        scale = min(1.0, step_rad / widest) if widest > 0 else 1.0
        trial = dict(self._reference)
        for name, gap in gaps.items():
            trial[name] += scale * gap
        return self._commit(trial, widest * (1 - scale), dt_s, arrived=widest * (1 - scale) < 0.02)

    def _cartesian(self, goal: HandPose, speed_mps: float, dt_s: float, roll_rad: float | None = None) -> ArmStep:
        assert self._reference is not None
        have = self._reacher.pose(self._reference)
        waypoint = have.towards(goal, speed_mps * dt_s, 1.0 * dt_s)
        trial = dict(self._reference)
        trial.update(zip(self._names, self._reacher.step(self._reference, waypoint).tolist(), strict=True))
        limit = 2.5 * dt_s
        for name in self._names:
            change = trial[name] - self._reference[name]
            trial[name] = self._reference[name] + min(max(change, -limit), limit)
        roll_gap = (self._roll_rad if roll_rad is None else roll_rad) - self._reference[self._roll]
        trial[self._roll] += min(max(roll_gap, -limit), limit)
        left = float(np.linalg.norm(self._reacher.point(goal) - self._reacher.point(have)))
        arrived = left < 0.004 and abs(goal.pitch_rad - have.pitch_rad) < 0.05 and abs(roll_gap) < 0.05
        if self._careful:
            measured = dict(zip(self._names, self._measured.tolist(), strict=True))
            place = self._reacher.position({**self._reference, **measured})
            left = max(left, float(np.linalg.norm(self._reacher.point(goal) - place)))
        return self._commit(trial, left, dt_s, arrived=arrived)

    def _commit(self, trial: dict[str, float], left: float, dt_s: float, *, arrived: bool) -> ArmStep:
        """Take a step, unless it brings the arm nearer to an obstacle than `clearance_m`."""
        assert self._reference is not None
        clearance_m = self.clearance.of(trial)
        before_m = self._clearance_m if self._clearance_m is not None else self.clearance.of(self._reference)
        blocked = clearance_m < self._config.clearance_m and clearance_m < before_m - 1e-6
        waits = self._waits
        if blocked or waits:
            trial = self._reference
        goal = np.array([trial[name] for name in self._names])
        moved = np.abs(goal - np.array([self._reference[name] for name in self._names]))
        # Faster than the reference, so that a lagging servo can catch up.
        speed = np.maximum(1.5 * moved / dt_s, _LEAST_PACE_RADPS)
        if waits:
            speed = np.full(len(goal), self._pace_radps)
        self._pace_radps = float(speed.max())
        self._reference = trial
        self._clearance_m = before_m if blocked or waits else clearance_m
        settled = not self._careful or bool(np.abs(goal - self._measured).max() < _SETTLED_RAD)
        arrived = arrived and settled and not (blocked or waits)
        return ArmStep(goal, self._together(goal, speed), trial[self._roll], left, arrived, blocked)
