"""`follow`: keep behind an object that moves."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from cocoro.messages import PlannerStatus
from cocoro.messages.actions import Follow
from cocoro.tasks import UNLIMITED_S, Limits, Skills, Task, TaskFailedError
from services.executive.tasks.steps import TargetLabel, find

WITHIN_M = 0.4
"""A robot that is off its distance by less is with the object."""
FRESH_S = 1.0
"""Age of the newest sighting up to which the distance counts as known, beyond the age that a sighting has when it
arrives."""
CATCH_UP_S = 10.0
"""Longest time to come to the distance first that does not count against the pursuit."""
SHARE = 0.5
"""Least share of the time with the object for which a pursuit has succeeded."""


class Company:
    """The share of the time for which the robot was with the object that it follows, by its own measure.

    The time begins when it is first with the object, at the latest `CATCH_UP_S` after it begins to follow.
    """

    def __init__(self) -> None:
        self._began_s: float | None = None
        self._from_s: float | None = None
        self._last_s = 0.0
        self._youngest_s = float("inf")
        """The least age of a sighting so far: about the time that perception takes."""
        self.with_s = 0.0

    def note(self, off_m: float | None, age_s: float, now_s: float) -> None:
        """Note how far off its distance it is, and how old that knowledge is."""
        self._youngest_s = min(self._youngest_s, age_s)
        near = off_m is not None and off_m <= WITHIN_M and age_s <= FRESH_S + self._youngest_s
        if self._began_s is None:
            self._began_s = self._last_s = now_s
        if self._from_s is None and (near or now_s - self._began_s > CATCH_UP_S):
            self._from_s = self._last_s = now_s
        if near:
            self.with_s += min(now_s - self._last_s, FRESH_S)
        self._last_s = now_s

    def share(self, now_s: float) -> float:
        """0 to 1; 0 while it has not come to the distance."""
        if self._from_s is None:
            return 0.0
        return min(self.with_s / (now_s - self._from_s), 1.0) if now_s > self._from_s else 1.0

    def verdict(self, now_s: float) -> str:
        """The reason for which the pursuit has failed; '' when it has succeeded."""
        if self._from_s is None:
            return f"it did not come within {WITHIN_M:g} m of the wanted distance"
        if (share := self.share(now_s)) >= SHARE:
            return ""
        total_s = now_s - self._from_s
        return (
            f"within {WITHIN_M:g} m of the wanted distance for {share:.0%} of {total_s:.0f} s; at least {SHARE:.0%} is"
            " a pursuit"
        )


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
        company = Company()

        def watch(status: PlannerStatus) -> None:
            age_s = status.target.age_s if status.target is not None else float("inf")
            company.note(status.distance_m, age_s, skills.now_s())
            skills.measure("near_share", company.share(skills.now_s()))

        await find(skills, self.label)
        while skills.now_s() < end_s:
            try:
                await skills.keep_doing(Follow(self.label), until_s=end_s, watch=watch)
            except TaskFailedError as failed:
                if failed.reason != "lost":
                    raise
                await self._find_again(skills, end_s)
        now_s = skills.now_s()
        skills.measure("near_share", company.share(now_s))
        if why := company.verdict(now_s):
            raise TaskFailedError("not_followed", why)

    async def _find_again(self, skills: Skills, end_s: float) -> None:
        """Look for the object until it is found or the time is over."""
        try:
            await find(skills, self.label)
        except TaskFailedError as failed:
            if failed.reason != "not_found" or skills.now_s() < end_s:
                raise
