"""Answers an operator who drives by hand, and has the planner do what counts."""

from __future__ import annotations

from collections.abc import Callable

from cocoro import topics
from cocoro.messages import DriveReply, DriveRequest
from cocoro.messages.actions import Drive
from cocoro.node import Node
from services.executive.skills import PlannerSkills


class ByHand:
    """Serves `topics.DRIVE`. `running()` is the running task's id, '' when none runs; `ended(task_id)` says in words
    what became of another one; `waits()` why the running one waits, '' when it does not."""

    def __init__(
        self,
        node: Node,
        skills: PlannerSkills,
        running: Callable[[], str],
        ended: Callable[[str], str],
        waits: Callable[[], str],
    ) -> None:
        self._skills = skills
        self._running = running
        self._ended = ended
        self._waits = waits
        node.serve(topics.DRIVE, self._drive)

    async def _drive(self, request: DriveRequest) -> DriveReply:
        if not request.task_id or request.task_id != self._running():
            return DriveReply(accepted=False, refusal="no_task", text=self._ended(request.task_id))
        skills = self._skills
        why_not = ""
        if skills.paused:
            why_not = self._waits() or "going on in a moment"
        elif not isinstance(skills.action, Drive):
            why_not = f"the task does not drive by hand now: {skills.action.name}"
        return skills.input(request.tick, request.motion, why_not)
