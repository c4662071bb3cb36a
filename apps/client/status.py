"""What a robot's services report, asked once."""

from __future__ import annotations

import asyncio
from typing import cast

import msgspec

from cocoro.messages import BaseState, Health, Latch, Message, PlannerStatus, TaskState
from cocoro.participant import Participant
from cocoro.topics import ANY, BASE_STATE, HEALTH, LATCH, PLAN, TASK

EXECUTIVE = "executive"
ANSWER_S = 1.0
"""Longest wait for a service's newest message; a service that is late counts as silent."""


class RobotStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The newest of everything that is asked for; None for what no service told."""

    alive: tuple[str, ...]
    """The services that are alive."""
    health: dict[str, Health]
    """By service; services of third parties, too."""
    task: TaskState | None
    """The running task, or the last one."""
    plan: PlannerStatus | None
    latch: Latch | None
    base: BaseState | None

    @property
    def ready(self) -> bool:
        """Whether no task runs, the emergency stop is released, and no service that is alive reports trouble."""
        free = self.task is None or not self.task.task_id or self.task.outcome is not None
        released = self.latch is not None and self.latch.state == "released"
        well = all(service in self.health and self.health[service].state == "ready" for service in self.alive)
        return free and released and well and EXECUTIVE in self.alive


async def status(participant: Participant) -> RobotStatus:
    """Asks all services at the same time. Raises nothing when some are silent."""
    asking = (participant.newest(topic, ANSWER_S) for topic in (HEALTH.of(ANY), TASK, PLAN, LATCH, BASE_STATE))
    alive, *answers = await asyncio.gather(participant.alive(), *asking)
    health, *news = (cast(list[Message], answer) for answer in answers)
    task, plan, latch, base = (found[0] if found else None for found in news)
    return RobotStatus(
        alive=tuple(cast(list[str], alive)),
        health={one.service: one for one in health if isinstance(one, Health)},
        task=task if isinstance(task, TaskState) else None,
        plan=plan if isinstance(plan, PlannerStatus) else None,
        latch=latch if isinstance(latch, Latch) else None,
        base=base if isinstance(base, BaseState) else None,
    )
