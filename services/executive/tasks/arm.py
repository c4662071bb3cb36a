"""`park` and `put-down`: the arm works, and the base stands unless the object is put down elsewhere."""

from __future__ import annotations

from cocoro.messages.actions import Carry, Park, PutDown
from cocoro.tasks import Skills, Task
from services.executive.tasks.steps import PlaceX, PlaceY, near_enough


class ParkTask(Task, frozen=True, kw_only=True, tag="park"):
    """Fold the arm."""

    async def run(self, skills: Skills) -> None:
        await skills.do(Park(), timeout_s=skills.limits.park_timeout_s)


class PutDownTask(Task, frozen=True, kw_only=True, tag="put-down"):
    """Set down what the hand holds: here, or at a place."""

    hand = "holding"
    needs_battery = False

    x_m: PlaceX | None = None
    y_m: PlaceY | None = None

    def __post_init__(self) -> None:
        if (self.x_m is None) != (self.y_m is None):
            raise ValueError("a place needs both x and y; without both, it is put down where the robot stands")

    async def run(self, skills: Skills) -> None:
        if self.x_m is not None and self.y_m is not None:
            place_m = near_enough(skills, self.x_m, self.y_m)
            await skills.do(Carry("", place_m), timeout_s=skills.limits.carry_timeout_s)
        await skills.do(PutDown(), timeout_s=skills.limits.place_timeout_s)
