"""`go-there`: drive to a place on the floor."""

from __future__ import annotations

from cocoro.messages.actions import GoThere
from cocoro.tasks import Skills, Task
from services.executive.tasks.steps import PlaceX, PlaceY, near_enough


class GoThereTask(Task, frozen=True, kw_only=True, tag="go-there"):
    """Drive to a place on the floor, around what stands in the way."""

    x_m: PlaceX
    y_m: PlaceY

    async def run(self, skills: Skills) -> None:
        place_m = near_enough(skills, self.x_m, self.y_m)
        await skills.do(GoThere(place_m), timeout_s=skills.limits.carry_timeout_s)
