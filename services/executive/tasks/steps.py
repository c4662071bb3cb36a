"""Steps that several tasks share."""

from __future__ import annotations

from math import hypot
from typing import Annotated

from msgspec import Meta

from cocoro.messages.actions import Explore, Search
from cocoro.tasks import Skills, TaskFailedError
from cocoro.units import Vec2

TargetLabel = Annotated[str, Meta(description="A known object; `cocoro objects` lists them.")]
PlaceX = Annotated[
    float, Meta(ge=-1000, le=1000, description="Place in the odometry frame: ahead of where the base was started.")
]
PlaceY = Annotated[float, Meta(ge=-1000, le=1000, description="To the left of where the base was started.")]
FARTHEST_M = 10.0
"""Distance of a place up to which the robot drives there: beyond what it has seen it would have to search its way."""
_ANSWER_S = 5.0


async def find(skills: Skills, label: str) -> None:
    """Look for an object, and go to look from elsewhere until all of the floor around was seen or time is up."""
    end_s = skills.now_s() + skills.limits.search_timeout_s
    try:
        while True:
            try:
                await skills.do(Search(label), timeout_s=max(end_s - skills.now_s(), 0.0))
                return
            except TaskFailedError as failed:
                if failed.reason != "not_found":
                    raise
            await skills.do(Explore(label), timeout_s=max(end_s - skills.now_s(), 0.0))
    except TaskFailedError as failed:
        if failed.reason != "timed_out":
            raise
    await skills.do(Explore(label, time_is_up=True), timeout_s=_ANSWER_S)
    raise TaskFailedError("not_found", f"time is up; {label} was not found")


def near_enough(skills: Skills, x_m: float, y_m: float) -> Vec2:
    """A place, odometry frame, that the robot may drive to. Raises TaskFailedError for one that is too far away."""
    here_m = skills.place()
    far_m = hypot(x_m - here_m[0], y_m - here_m[1])
    if far_m > FARTHEST_M:
        raise TaskFailedError(
            "unreachable", f"the place is {far_m:.1f} m away; give one within {FARTHEST_M:g} m of the robot"
        )
    return x_m, y_m
