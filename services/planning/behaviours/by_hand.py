"""Driving by hand: the robot does what its operator wants, as far as that is safe, and says why where it is not."""

from __future__ import annotations

from cocoro.messages import BaseCommand, Motion
from cocoro.messages.actions import Drive
from services.planning.behaviours.base import Plan, Snapshot
from services.planning.behaviours.cautious_base import CautiousBase
from services.planning.caution import Allowed
from services.planning.steering import SteeredGrip, SteeredHand, SteeredHead

_REST = Motion()


class DrivingByHand:
    """Moves base, arm, claws and head at the rates that the operator wants now; without his input all is at rest.

    While perception is late the wheels stand, as in all driving; arm and head move on.
    """

    needs_sight = False

    def __init__(self, action: Drive) -> None:
        self._base = CautiousBase()
        self._hand = SteeredHand()
        self._head = SteeredHead()
        self._grip = SteeredGrip()

    def step(self, snapshot: Snapshot) -> Plan:
        actuators = snapshot.actuators
        motion, why_not = actuators.gaze.steered(snapshot.estimator.motion(snapshot.now_ns) or _REST)
        fields = self._base.look(snapshot)
        self._grip.step(snapshot, motion)
        arm = self._hand.step(snapshot, motion, fields)
        allowed = Allowed(0.0, 0.0)
        if not motion.base:
            base = actuators.driver.halt()
        elif self._hand.unfolding and motion.hand:
            base = snapshot.stand()
        else:
            base, allowed = self._base.drive(snapshot, motion, fields, looks=self._head.free(snapshot))
        head = self._head.step(snapshot, motion, self._hand.look_at or allowed.look_at)
        why = "; ".join(filter(None, (allowed.why, self._hand.why, why_not))) or _what(motion, base)
        return Plan(base, arm, why, head)


def _what(motion: Motion, base: BaseCommand) -> str:
    """What happens, in words."""
    if motion.zero:
        return "at rest: nothing is held"
    if motion.aside_mps:
        ahead_mps, aside_mps = round(base.ahead_mps, 2) + 0.0, round(base.aside_mps, 2) + 0.0  # no -0.00
        return f"driving by hand, {ahead_mps:+.2f} m/s ahead, {aside_mps:+.2f} m/s to the left"
    if motion.speed_mps:
        return f"driving by hand, {base.ahead_mps:+.2f} m/s"
    if motion.base:
        return "turning by hand"
    return "turning the head" if motion.head else "moving the claws"
