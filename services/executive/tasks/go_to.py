"""`go-to`: drive to an object and stop at a distance from it."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from cocoro.messages.actions import GoTo
from cocoro.tasks import Skills, Task
from services.executive.tasks.steps import TargetLabel, find


class GoToTask(Task, frozen=True, kw_only=True, tag="go-to"):
    """Drive to an object and stop at a distance from it."""

    needs_label = "known"

    label: TargetLabel
    distance_m: Annotated[
        float, Meta(ge=0, le=5, description="From the robot's centre to the object's nearest edge, over the floor.")
    ] = 0.2

    async def run(self, skills: Skills) -> None:
        await find(skills, self.label)
        radius_m = max(skills.size_m(self.label)[:2]) / 2  # the planner counts from centre to centre
        await skills.do(GoTo(self.label, self.distance_m + radius_m), timeout_s=skills.limits.approach_timeout_s)
