"""`policy`: a learned policy moves the robot, as far as that is safe."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from cocoro.messages.actions import FollowPolicy
from cocoro.tasks import UNLIMITED_S, Limits, Skills, Task


class PolicyTask(Task, frozen=True, kw_only=True, tag="policy"):
    """Let a learned policy move arm, head, hand and base, within all limits, until it says that it has finished."""

    hand = "any"
    services = ("policy",)

    label: Annotated[str, Meta(description="A policy of the profile, from its table service.policy.")]
    for_s: Annotated[float, Meta(gt=0, le=3600, description="Let it for so long, then stop.")] | None = None

    def limit_s(self, limits: Limits) -> float:
        return UNLIMITED_S

    async def run(self, skills: Skills) -> None:
        until_s = skills.now_s() + (self.for_s or UNLIMITED_S)
        await skills.keep_doing(FollowPolicy(self.label), until_s=until_s)
