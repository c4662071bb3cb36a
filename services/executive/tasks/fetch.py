"""`fetch`: find an object, drive there, grasp it, lift it, and perhaps bring it back."""

from __future__ import annotations

from collections import Counter
from typing import Annotated

from msgspec import Meta

from cocoro.messages.actions import Approach, Carry, Close, Lift, PutDown, Reach
from cocoro.tasks import Skills, Task, TaskFailedError
from services.executive.tasks.steps import TargetLabel, find

_LOOK_AGAIN = ("lost", "unreachable")
_TRY_AGAIN = ("slipped", "no_grip")


class FetchTask(Task, frozen=True, kw_only=True, tag="fetch"):
    """Find an object, drive there, grasp it and lift it."""

    needs_label = "graspable"
    snapshot_phase = "grasp"

    label: TargetLabel
    bring: Annotated[bool, Meta(description="Bring it to where the task began and put it down.")] = False

    async def run(self, skills: Skills) -> None:
        begun_m, limits = skills.place(), skills.limits
        await self._pick_up(skills)
        if self.bring:
            await skills.do(Carry(self.label, begun_m), timeout_s=limits.carry_timeout_s)
            await skills.do(PutDown(), timeout_s=limits.place_timeout_s)

    async def _pick_up(self, skills: Skills) -> None:
        tries: Counter[str] = Counter()
        label, limits = self.label, skills.limits
        while True:
            try:
                await find(skills, label)
                await skills.do(Approach(label), timeout_s=limits.approach_timeout_s)
                await skills.do(Reach(label), timeout_s=limits.reach_timeout_s)
                await skills.do(Close(label), timeout_s=limits.grasp_timeout_s)
                await skills.do(Lift(label), timeout_s=limits.lift_timeout_s)
                await skills.watch_hold(limits.hold_s)
                return
            except TaskFailedError as failed:
                kind = "look" if failed.reason in _LOOK_AGAIN else "try" if failed.reason in _TRY_AGAIN else ""
                tries[kind] += 1
                allowed = {"look": limits.relocate_tries, "try": limits.grasp_tries - 1}.get(kind, 0)
                if tries[kind] > allowed:
                    raise
