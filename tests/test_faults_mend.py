"""Services that die in the middle of a task and are restarted, links that are cut and come back: the task goes on.

Policies: docs/faults.md. In virtual time, with the whole robot, judged by the simulator's truth.
"""

from __future__ import annotations

import pytest
from robot_rig import HALTED_MPS, RobotRig

from cocoro.messages import TaskState
from cocoro.testing import in_virtual_time

pytestmark = pytest.mark.sim

STAND_S = 0.3
"""Bound from the fault until the body stands, by the true state."""
RESTART_S = 3.0
"""Time from a death until the service is back."""
PHASES = ("search", "approach", "reach", "grasp", "lift", "hold")
INTO_S = {"search": 0.1, "approach": 1.5, "reach": 0.3, "grasp": 0.1, "lift": 0.5, "hold": 1.0}
"""Time from the begin of a phase to the fault."""


def ended_well(rig: RobotRig, state: TaskState) -> None:
    assert (state.outcome, state.reason) == ("done", ""), state
    assert rig.held("red_can")


@pytest.mark.parametrize("service", ["perception", "planning"])
@pytest.mark.parametrize("phase", PHASES)
def test_a_fetch_stands_while_a_service_is_restarted_and_goes_on_to_its_end(service: str, phase: str) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with RobotRig() as rig:
            task_id = await rig.begin("fetch", "red_can")
            await rig.phase(task_id, phase)
            await rig.advance(INTO_S[phase])
            assert rig.state(task_id).phase == phase
            held = rig.held("red_can")
            died_s = rig.now_s
            await rig.kill(service)
            await rig.advance(RESTART_S)
            assert max(rig.speeds_since(died_s + STAND_S)) < HALTED_MPS
            assert rig.turned_since(died_s + STAND_S) < 0.01
            assert rig.state(task_id).text == f"lost contact with {service}"
            assert rig.held("red_can") or not held
            await rig.start(service)
            ended_well(rig, await rig.outcome(task_id))

    scenario()
