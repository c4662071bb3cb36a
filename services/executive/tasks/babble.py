"""`babble-arm` and `babble-wheels`: move to learn, and report samples."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from cocoro.messages.actions import BabbleArm, BabbleWheels, Park, Search
from cocoro.tasks import UNLIMITED_S, Limits, Skills, Task
from cocoro.topics import HAND_SAMPLES, WHEEL_TRIALS
from services.executive.tasks.steps import TargetLabel

First = Annotated[
    int, Meta(ge=0, description="Number to go on with where an earlier run ended.", extra={"option": False})
]


class BabbleArmTask(Task, frozen=True, kw_only=True, tag="babble-arm"):
    """Move the arm about and look at the hand, then fold the arm."""

    needs_body = ("marker",)
    samples = HAND_SAMPLES

    first: First = 0
    count: Annotated[int, Meta(ge=1, le=1_000_000, description="How many samples.")] = 1000

    def limit_s(self, limits: Limits) -> float:
        return UNLIMITED_S

    async def run(self, skills: Skills) -> None:
        await skills.do(BabbleArm(self.first, self.count), timeout_s=skills.limits.babble_timeout_s)
        await skills.do(Park(), timeout_s=skills.limits.park_timeout_s)


class BabbleWheelsTask(Task, frozen=True, kw_only=True, tag="babble-wheels"):
    """Turn the wheels to and fro before an object that stands."""

    needs_label = "known"
    needs_body = ("neck",)
    samples = WHEEL_TRIALS

    label: TargetLabel
    first: First = 0
    count: Annotated[int, Meta(ge=1, le=1_000_000, description="How many trials.")] = 1000

    def limit_s(self, limits: Limits) -> float:
        return UNLIMITED_S

    async def run(self, skills: Skills) -> None:
        limits = skills.limits
        await skills.do(Park(), timeout_s=limits.park_timeout_s)
        await skills.do(Search(self.label), timeout_s=limits.search_timeout_s)
        await skills.do(BabbleWheels(self.label, self.first, self.count), timeout_s=limits.babble_timeout_s)
