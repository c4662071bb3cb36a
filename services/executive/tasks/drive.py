"""`drive`: an operator drives by hand."""

from __future__ import annotations

from contextlib import suppress

from cocoro.messages import PlannerStatus
from cocoro.messages.actions import Drive
from cocoro.tasks import UNLIMITED_S, Limits, Skills, Task

LEFT_ALONE_S = 60.0
"""The task ends when nothing was driven for so long, so that a forgotten one does not keep the robot from others."""


class _LeftAloneError(Exception):
    """Nothing was driven for too long."""


class DriveTask(Task, frozen=True, kw_only=True, tag="drive"):
    """Drive by hand: base, head, arm and claws."""

    hand = "any"
    needs_battery = False

    def limit_s(self, limits: Limits) -> float:
        return UNLIMITED_S

    async def run(self, skills: Skills) -> str:
        def watch(status: PlannerStatus) -> None:
            if skills.since_input_s() > LEFT_ALONE_S:
                raise _LeftAloneError

        with suppress(_LeftAloneError):
            await skills.keep_doing(Drive(), until_s=float("inf"), watch=watch)
        return f"left_alone: nothing was driven for {LEFT_ALONE_S:g} s"
