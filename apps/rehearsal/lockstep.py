"""The baseline in lock-step: one serial cycle of perception and planning, as in the paper (Galbraith et al. 2015).

The services' own cores are stepped in turn (`LockstepCycle`), and the planner is replaced by `LockstepPlanner`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import replace as with_fields
from typing import Any

from msgspec.structs import replace

from cocoro.clock import NS
from cocoro.component import Component, Implementation
from cocoro.core import Core, Output, Sample, Schedule
from cocoro.messages import ServoState
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.stepper import Stepper
from cocoro.topics import DETECTIONS, HAND_STATE
from deploy.delayed import DelayedNode
from deploy.processes import named
from services.planning.behaviours import Plan, Snapshot
from services.planning.config import PlanningConfig
from services.planning.core import PlanningCore
from services.planning.navigation import Driver, Offset
from services.planning.service import plan

LONG_S = 60.0
LOCKSTEP_SETTINGS: Mapping[str, dict[str, Any]] = {
    "sim": {"command_timeout_s": LONG_S},
    "executive": {"planner_late_s": LONG_S, "planner_silence_s": LONG_S},
}
"""Settings of the other services, by service: commands are held, and the planner is silent, for a whole cycle."""


MOST_SHARE = 0.8
"""Greatest share of an error that one cycle may make up for. Gains that a shorter cycle allows would swing at a long
one: a serial robot is tuned for its cycle."""


class LockstepDriver(Driver):
    """Drives no further and turns no further in a cycle than is left."""

    cycle_s = 0.0
    """Time for which the next command is held."""

    def law(self, offset: Offset) -> tuple[float, float]:
        speed, turn = super().law(offset)
        if self.cycle_s <= 0:
            return speed, turn
        most = MOST_SHARE / self.cycle_s
        return _within(speed, most * abs(offset.ahead_m)), _within(turn, most * abs(offset.heading_rad))


def _within(value: float, most: float) -> float:
    return max(min(value, most), -most)


class LockstepPlanner(PlanningCore):
    """Plans once per cycle, whatever the age of its inputs. The arm waits until the base stands. The gains are as high
    as the cycle's length, which it measures, allows (`MOST_SHARE`)."""

    LONGEST_STEP_S = 1.0

    def __init__(self, robot: Robot, config: PlanningConfig) -> None:
        super().__init__(robot, config)
        self.actuators.ready_on_the_way = False
        self._driver = self.actuators.driver = LockstepDriver(config.navigation, robot.base)
        self._driver.turn_with(self.learned.separation_m)

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        if self._stepped_ns is not None and now_ns > self._stepped_ns:
            self._tune((now_ns - self._stepped_ns) / NS)
        self._stepped_ns = now_ns
        for sample in inputs:  # the grip is judged by all that was measured in the cycle, as without lock-step
            if isinstance(sample.message, ServoState) and sample.topic.name == HAND_STATE.name:
                self.actuators.grip.feel(sample.message, sample.message.stamp_ns)
        return super().step(inputs, now_ns)

    _stepped_ns: int | None = None

    def _tune(self, cycle_s: float) -> None:
        self._driver.cycle_s, most_per_s = cycle_s, MOST_SHARE / cycle_s
        follow = self._config.follow
        tuned = replace(
            follow,
            gain_per_s=min(follow.gain_per_s, most_per_s),
            turn_gain_per_s=min(follow.turn_gain_per_s, most_per_s),
        )
        self.actuators.config = replace(self._config, follow=tuned)

    @property
    def schedule(self) -> Schedule:
        return Schedule(None, (DETECTIONS,))

    def slow_down(self, plan: Plan, snapshot: Snapshot) -> None:
        """Keeps the speed: every service waits for the others, and commands do not expire."""


async def run(node: Node, config: PlanningConfig) -> None:
    await plan(node, config, LockstepPlanner(node.robot, config))


implementation = Implementation(PlanningConfig, run, LockstepPlanner)
PLANNING_MODULE = named("planning").module
LOCKSTEP_PLANNER: Component = with_fields(named("planning"), module=__name__)
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
