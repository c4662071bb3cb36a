"""`touch`: bring the open hand around something within the arm's reach."""

from __future__ import annotations

from cocoro.messages.actions import Search, Touch
from cocoro.tasks import Skills, Task
from services.executive.tasks.steps import TargetLabel


class TouchTask(Task, frozen=True, kw_only=True, tag="touch"):
    """Bring the open hand around something within reach, on the floor or in the air; the wheels stand."""

    needs_label = "graspable"

    label: TargetLabel

    async def run(self, skills: Skills) -> None:
        status, limits = skills.status, skills.limits
        known = status is not None and any(item.label == self.label for item in status.known)
        if not known:  # what is known need not be in view: the hand may hide it
            await skills.do(Search(self.label), timeout_s=limits.search_timeout_s)
        await skills.do(Touch(self.label), timeout_s=limits.reach_timeout_s)
