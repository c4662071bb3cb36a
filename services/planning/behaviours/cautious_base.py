"""The base as somebody else wants it to move, an operator or a policy, as far as that is safe."""

from __future__ import annotations

from math import hypot

import numpy as np

from cocoro.messages import BaseCommand, Motion
from services.planning.arm_guard import HELD_M
from services.planning.behaviours.base import Snapshot, hand_place
from services.planning.behaviours.driving import BackOff
from services.planning.caution import Allowed, ArmHull, Caution, limited
from services.planning.navigation import GENTLE
from services.planning.surroundings import Fields

_REACHED_FOR_M, _LEFT_M = 0.15, 0.20
"""A known object that comes so near to the unfolded hand is not in the way, until it is further away again."""


class CautiousBase:
    """Drives at wanted rates within what `Caution` allows. One behaviour has one."""

    def __init__(self) -> None:
        self._caution: Caution | None = None
        self._frame: int | None = None
        self._reached_for = ""
        self._bumped = False

    def look(self, snapshot: Snapshot) -> Fields:
        """Take note of where the robot stands, in every step. Returns what is in its way: the known object that the
        unfolded hand reaches for is not."""
        self._know(snapshot)
        return snapshot.fields(self._near_hand(snapshot))

    def _know(self, snapshot: Snapshot) -> None:
        """What is known of where the robot has been, and of what its bumper touches."""
        base = snapshot.estimator.base
        assert base is not None
        if self._caution is None:
            self._caution = Caution(snapshot.actuators.robot, snapshot.actuators.config)
        if self._frame != base.incarnation:
            self._frame = base.incarnation
            self._caution.forget()
        self._caution.stood(snapshot.body, snapshot.now_ns)
        bumped = base.bump_left or base.bump_right
        if bumped and not self._bumped:
            snapshot.estimator.around.floor.bump(BackOff.touched(snapshot, base))
        self._bumped = bumped

    def _near_hand(self, snapshot: Snapshot) -> str:
        """The known object that the unfolded hand reaches for or holds; '' when there is none."""
        arm = snapshot.actuators.arm
        if arm.folded(arm.reference or snapshot.angles):
            self._reached_for = ""
            return ""
        x, y, _ = hand_place(snapshot)
        known = snapshot.estimator.memory.all(snapshot.body, snapshot.now_ns, sure=True)
        away_m = {
            item.label: hypot(item.position_m[0] - x, item.position_m[1] - y)
            for item in known
            if item.label != snapshot.actuators.config.marker
        }
        if away_m.get(self._reached_for, _LEFT_M) >= _LEFT_M:
            nearest = min(away_m, key=away_m.__getitem__, default="")
            self._reached_for = nearest if nearest and away_m[nearest] < _REACHED_FOR_M else ""
        return self._reached_for

    def drive(self, snapshot: Snapshot, motion: Motion, fields: Fields, *, looks: bool) -> tuple[BaseCommand, Allowed]:
        """One step of a wanted motion of the base; call `look` before. `looks`: the head goes where `look_at` of what
        is allowed says."""
        actuators, estimator = snapshot.actuators, snapshot.estimator
        config, driver = actuators.config, actuators.driver
        if estimator.blind_s(snapshot.now_ns) is not None:
            late_s = estimator.unseen_s(snapshot.now_ns)
            why = f"standing still: nothing from perception for {late_s:.1f} s"
            return driver.pause(snapshot.dt_s), Allowed(0.0, 0.0, why)
        assert self._caution is not None
        arm = self._hull(snapshot)
        most_mps = config.navigation.max_speed_mps if arm is None else config.by_hand.arm_out_mps
        turn = limited(motion.turn_radps, config.navigation.max_turn_radps)
        speed_mps, aside_mps = limited(motion.speed_mps, most_mps), 0.0
        if motion.aside_mps and actuators.robot.drive.goes_aside:
            share = min(most_mps / hypot(motion.speed_mps, motion.aside_mps), 1.0)
            speed_mps, aside_mps = share * motion.speed_mps, share * motion.aside_mps
        allowed = self._caution.allow(
            speed_mps, turn, snapshot.body, estimator.around, fields, driver,
            snapshot.now_ns, arm=arm, looks=looks, aside_mps=aside_mps,
        )  # fmt: skip
        if motion.aside_mps and not aside_mps:
            allowed = allowed._replace(why="; ".join(filter(None, ("this base cannot move aside", allowed.why))))
        if self._bumped and (speed_mps > 0.0 or aside_mps):
            allowed = allowed._replace(speed_mps=0.0, aside_mps=0.0, why="the bumper touches something: back off")
        pace = 1.0 if arm is None else GENTLE
        command = driver.command(
            allowed.speed_mps, allowed.turn_radps, snapshot.dt_s, pace=pace, aside_mps=allowed.aside_mps
        )
        # As `PlanningCore.slow_down` does for behaviours that need sight all the time.
        who, age_s = estimator.oldest(snapshot.now_ns, sight=True)
        slower = driver.within(command, actuators.robot.base.speed_at_age_mps(age_s + 1.0 / config.rate_hz))
        if slower is not command and not allowed.why:
            allowed = allowed._replace(why=f"slower, for {who} is late")
        return slower, allowed

    @staticmethod
    def _hull(snapshot: Snapshot) -> ArmHull | None:
        """The arm where it is beyond the body; None when it is folded."""
        actuators = snapshot.actuators
        if actuators.arm.parked(snapshot.angles):
            return None
        centres, radii = actuators.arm.clearance.hull(snapshot.angles)
        if snapshot.holding:
            centres, radii = np.vstack([centres, hand_place(snapshot)]), np.append(radii, HELD_M)
        beyond = np.hypot(centres[:, 0], centres[:, 1]) + radii > actuators.robot.base.chassis_diameter_m / 2
        centres, radii = centres[beyond], radii[beyond]
        low = centres[:, 2] - radii < actuators.config.by_hand.low_m
        return ArmHull(centres[:, :2], radii, low) if len(centres) else None
