"""`follow`: keep behind an object that moves."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from cocoro.messages.actions import Follow
from cocoro.tasks import UNLIMITED_S, Limits, Skills, Task, TaskFailedError
from services.executive.tasks.steps import TargetLabel, find


class FollowTask(Task, frozen=True, kw_only=True, tag="follow"):
    """Keep behind an object that moves, at a distance, for a time or until it is cancelled."""

    needs_label = "known"
    pursuit_phase = "follow"

    label: TargetLabel
    for_s: Annotated[float, Meta(gt=0, le=3600, description="Follow for so long, then stop.")] | None = None

    def limit_s(self, limits: Limits) -> float:
        return (self.for_s or UNLIMITED_S) + limits.search_timeout_s

    async def run(self, skills: Skills) -> None:
        end_s = skills.now_s() + (self.for_s or float("inf"))
        await find(skills, self.label)
        while skills.now_s() < end_s:
            try:
                await skills.keep_doing(Follow(self.label), until_s=end_s)
            except TaskFailedError as failed:
                if failed.reason != "lost":
                    raise
                await find(skills, self.label)
