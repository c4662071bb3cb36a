"""Steps that several tasks share."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from cocoro.messages.actions import Explore, Search
from cocoro.tasks import Skills, TaskFailedError

TargetLabel = Annotated[str, Meta(description="A known object; `cocoro objects` lists them.")]


async def find(skills: Skills, label: str) -> None:
    """Search all around; where the object is not in view, go and look from elsewhere."""
    limits = skills.limits
    for left in reversed(range(limits.viewpoints)):
        try:
            await skills.do(Search(label), timeout_s=limits.search_timeout_s)
            return
        except TaskFailedError as failed:
            if failed.reason != "not_found" or left == 0:
                raise
        await skills.do(Explore(label), timeout_s=limits.explore_timeout_s)
