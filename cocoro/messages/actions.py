"""The actions that the executive asks of the planner: one type each, with a tag on the wire."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cocoro.entry_points import added_to
from cocoro.messages.common import Count, FiniteNonNegative, FiniteVec2
from cocoro.tagged import Registry, Tagged

TASK_GROUP = "cocoro.tasks"
"""The entry point group of third parties' tasks, which may bring actions of their own."""


class Action(Tagged, frozen=True, tag_field="action"):
    """One thing for the planner to do. A behaviour of `services.planning.behaviours` carries it out."""

    def behaviour(self) -> Any:
        """A new behaviour that carries out this action. Third parties' actions implement it; those of the project are
        in the planner's table."""
        raise NotImplementedError(f"action {self.name} has no behaviour")


class Idle(Action, frozen=True, tag="idle"):
    """Stand still and hold everything as it is."""


class Park(Action, frozen=True, tag="park"):
    """Fold the arm and look ahead."""


class Search(Action, frozen=True, tag="search"):
    """Look from here for an object, at the floor that was not seen yet; the base stands."""

    label: str


class Explore(Action, frozen=True, tag="explore"):
    """Drive to where unseen floor can be seen. Fails, and says what was not seen, when there is none or time is up."""

    label: str
    time_is_up: bool = False


class Approach(Action, frozen=True, tag="approach"):
    """Drive to where the arm reaches an object."""

    label: str


class Reach(Action, frozen=True, tag="reach"):
    """Bring the open claws around an object; the base stands."""

    label: str


class Close(Action, frozen=True, tag="grasp"):
    """Close the claws until something stops them."""

    label: str


class Lift(Action, frozen=True, tag="lift"):
    """Lift what the claws hold."""

    label: str


class Carry(Action, frozen=True, tag="carry"):
    """Drive, with an object in the hand, to where it is to be put down."""

    label: str
    place_m: FiniteVec2
    """Odometry frame."""


class PutDown(Action, frozen=True, tag="place"):
    """Put down here what the claws hold."""


class Follow(Action, frozen=True, tag="follow"):
    """Keep a set distance to a moving object. Has no end."""

    label: str


class Touch(Action, frozen=True, tag="touch"):
    """Bring the open hand around what is within the arm's reach; the base stands."""

    label: str


class GoTo(Action, frozen=True, tag="go-to"):
    """Drive to an object, the arm folded."""

    label: str
    distance_m: FiniteNonNegative
    """From the body's centre to the object's, over the floor, at the end."""


class Drive(Action, frozen=True, tag="drive"):
    """Do what the operator's hand wants now: the motion in the intent, while it counts. Has no end."""


class GoThere(Action, frozen=True, tag="go-there"):
    """Drive to a place on the floor, the arm folded."""

    place_m: FiniteVec2
    """Where the body's centre is to be at the end, odometry frame."""


class FollowPolicy(Action, frozen=True, tag="policy"):
    """Do what the learned policy of this name proposes, as far as it is safe. Ends when the policy says so."""

    label: str


class BabbleArm(Action, frozen=True, tag="babble-arm"):
    """Move the arm from draw to draw and report where the hand is seen."""

    first: Count
    """Number of the first draw."""
    count: Count
    """Samples after which it is done."""


class BabbleWheels(Action, frozen=True, tag="babble-wheels"):
    """Turn the wheels in pairs of trials and report where a standing object is seen before and after each."""

    label: str
    first: Count
    """Number of the first trial."""
    count: Count
    """Trials after which it is done."""


def _brought() -> Iterator[type[Action]]:
    """Third parties' actions that have a behaviour: one without would end the planner."""
    for _, task, _ in added_to(TASK_GROUP).added:
        yield from (kind for kind in getattr(task, "brings", ()) if kind.behaviour is not Action.behaviour)


ACTIONS: Registry[Action] = Registry(
    "action",
    (
        Idle, Park, Search, Explore, Approach, Reach, Close, Lift, Carry, PutDown, Follow, Touch, GoTo, GoThere, Drive,
        FollowPolicy, BabbleArm, BabbleWheels,
    ),
    _brought,
)  # fmt: skip
"""All actions by name."""
