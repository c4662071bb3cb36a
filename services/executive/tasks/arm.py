"""`park` and `put-down`: the base stands, the arm works."""

from __future__ import annotations

from cocoro.messages.actions import Park, PutDown
from cocoro.tasks import Skills, Task


class ParkTask(Task, frozen=True, kw_only=True, tag="park"):
    """Fold the arm."""

    async def run(self, skills: Skills) -> None:
        await skills.do(Park(), timeout_s=skills.limits.park_timeout_s)


class PutDownTask(Task, frozen=True, kw_only=True, tag="put-down"):
    """Set down what the hand holds."""

    hand = "holding"
    needs_battery = False

    async def run(self, skills: Skills) -> None:
        await skills.do(PutDown(), timeout_s=skills.limits.place_timeout_s)
