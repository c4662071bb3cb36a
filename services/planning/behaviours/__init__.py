"""What the planner can be asked to do. Each behaviour is a small state machine that is stepped at the planner's rate,
says what it wants of base, head, arm and hand, and why, and ends as done or failed."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from cocoro.messages import Intent
from services.planning.behaviours.babbling import BabbleArm, BabbleWheels
from services.planning.behaviours.base import Actuators, Behaviour, Plan, Snapshot
from services.planning.behaviours.driving import Approach, Carry, Follow
from services.planning.behaviours.going import GoTo
from services.planning.behaviours.handling import Close, Lift, Place, Reach
from services.planning.behaviours.looking import Explore, Idle, Park, Search
from services.planning.behaviours.touching import Touch

__all__ = ["BEHAVIOURS", "Actuators", "Behaviour", "Idle", "Plan", "Snapshot"]

BEHAVIOURS: Mapping[str, Callable[[Intent], Behaviour]] = {
    "idle": lambda _intent: Idle(),
    "park": lambda _intent: Park(),
    "search": lambda intent: Search(intent.label),
    "explore": lambda intent: Explore(intent.label),
    "approach": lambda intent: Approach(intent.label),
    "reach": lambda intent: Reach(intent.label),
    "grasp": lambda _intent: Close(),
    "lift": lambda _intent: Lift(),
    "carry": lambda intent: Carry(intent.label, intent.place_m or (0.0, 0.0)),
    "place": lambda _intent: Place(),
    "follow": lambda intent: Follow(intent.label),
    "touch": lambda intent: Touch(intent.label),
    "go-to": lambda intent: GoTo(intent.label, intent.distance_m),
    "babble-arm": lambda intent: BabbleArm(intent.first, intent.count),
    "babble-wheels": lambda intent: BabbleWheels(intent.label, intent.first, intent.count),
}
