"""Behaviours: small state machines, one for each action, that are stepped at the planner's rate. Each step gives a plan
for base, head and arm, with the reason, until the behaviour is done or has failed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from cocoro.messages import actions
from cocoro.messages.actions import Action
from services.planning.behaviours.babbling import ArmBabbling, WheelBabbling
from services.planning.behaviours.base import Actuators, Behaviour, Plan, Snapshot
from services.planning.behaviours.by_hand import DrivingByHand
from services.planning.behaviours.driving import Approaching, Carrying
from services.planning.behaviours.following import Following
from services.planning.behaviours.going import Going
from services.planning.behaviours.going_there import GoingThere
from services.planning.behaviours.handling import Closing, Lifting, PuttingDown, Reaching
from services.planning.behaviours.looking import Exploring, Idling, Parking, Searching
from services.planning.behaviours.policy import FollowingPolicy
from services.planning.behaviours.touching import Touching

__all__ = ["BEHAVIOURS", "Actuators", "Behaviour", "Idling", "Plan", "Snapshot", "behaviour_for"]

BEHAVIOURS: Mapping[type[Action], Callable[[Any], Behaviour]] = {
    actions.Idle: Idling,
    actions.Park: Parking,
    actions.Search: Searching,
    actions.Explore: Exploring,
    actions.Approach: Approaching,
    actions.Reach: Reaching,
    actions.Close: Closing,
    actions.Lift: Lifting,
    actions.Carry: Carrying,
    actions.PutDown: PuttingDown,
    actions.Follow: Following,
    actions.Touch: Touching,
    actions.GoTo: Going,
    actions.Drive: DrivingByHand,
    actions.GoThere: GoingThere,
    actions.FollowPolicy: FollowingPolicy,
    actions.BabbleArm: ArmBabbling,
    actions.BabbleWheels: WheelBabbling,
}
"""The behaviour of each of the project's actions. A third party's action makes its own."""


def behaviour_for(action: Action) -> Behaviour:
    """A new behaviour that carries out an action."""
    make = BEHAVIOURS.get(type(action))
    behaviour: Behaviour = make(action) if make is not None else action.behaviour()
    return behaviour
