"""Steps that several tasks share."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from cocoro.messages.actions import Explore, Search
from cocoro.tasks import Skills, TaskFailedError

TargetLabel = Annotated[str, Meta(description="A known object; `cocoro objects` lists them.")]
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
