"""The baseline in lock-step: one serial cycle of perception and planning, as in the paper (Galbraith et al. 2015).

The services' own cores are stepped in turn (`LockstepCycle`), and the planner is replaced by `LockstepPlanner`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from cocoro.component import Component, Implementation
from cocoro.core import Core, Schedule
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.stepper import Stepper
from cocoro.topics import DETECTIONS
from deploy.delayed import DelayedNode
from deploy.processes import named
from services.planning.behaviours import Plan, Snapshot
from services.planning.config import PlanningConfig
from services.planning.core import PlanningCore
from services.planning.service import plan

LONG_S = 60.0
LOCKSTEP_SETTINGS: Mapping[str, dict[str, Any]] = {
    "sim": {"command_timeout_s": LONG_S},
    "executive": {"planner_late_s": LONG_S, "planner_silence_s": LONG_S},
}
"""Settings of the other services, by service: commands are held, and the planner is silent, for a whole cycle."""


class LockstepPlanner(PlanningCore):
    """Plans once per cycle, whatever the age of its inputs. The arm waits until the base stands."""

    LONGEST_STEP_S = 1.0

    def __init__(self, robot: Robot, config: PlanningConfig) -> None:
        super().__init__(robot, config)
        self.actuators.ready_on_the_way = False

    @property
    def schedule(self) -> Schedule:
        return Schedule(None, (DETECTIONS,))

    def slow_down(self, plan: Plan, snapshot: Snapshot) -> None:
        """Keeps the speed: every service waits for the others, and commands do not expire."""


async def run(node: Node, config: PlanningConfig) -> None:
    await plan(node, config, LockstepPlanner(node.robot, config))


implementation = Implementation(PlanningConfig, run, LockstepPlanner)
PLANNING_MODULE = named("planning").module
LOCKSTEP_PLANNER: Component = replace(named("planning"), module=__name__)
"""The planner of a rehearsal in lock-step."""


class LockstepCycle:
    """One serial cycle: sense, perceive, plan, act. The next cycle begins when the last has ended; commands are held
    meanwhile. Injected latencies are part of the cycle."""

    ORDER = ("perception", "planning")

    def __init__(self) -> None:
        self._steps: dict[str, tuple[Node, Stepper]] = {}

    async def join(self, node: Node, core: Core) -> None:
        """Takes the place of `Node.drive`: the core is stepped when its turn comes."""
        self._steps[node.name] = (node, node.stepper(core))
        node.ready()
        if set(self._steps) == set(self.ORDER):
            await self._run()
        else:
            await asyncio.get_running_loop().create_future()

    async def _run(self) -> None:
        perceiver, perceive = self._steps["perception"]
        planner, plan = self._steps["planning"]
        while True:
            await perceive.wake.wait()
            perceive.wake.clear()
            if await perceive(perceiver.now_ns()):
                # Lets the published messages arrive; no time passes.
                await asyncio.sleep(0)
                await plan(planner.now_ns())


class LockstepNode(DelayedNode):
    """A node whose core is driven by the cycle."""

    def __init__(self, *args: Any, cycle: LockstepCycle, **options: Any) -> None:
        super().__init__(*args, **options)
        self._cycle = cycle

    async def drive(self, core: Core, name: str | None = None) -> None:
        await self._cycle.join(self, core)
