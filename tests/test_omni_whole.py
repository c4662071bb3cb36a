"""The whole robot on omni wheels in virtual time, judged by the true state: driven aside by hand, and by itself."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from math import hypot

import pytest
from omni_robot import omni_robot
from robot_rig import HALTED_MPS, RobotRig

from cocoro import topics
from cocoro.driving import Driving
from cocoro.messages import Motion
from cocoro.testing import in_virtual_time

pytestmark = pytest.mark.sim

OBLIQUE = Motion(speed_mps=0.18, aside_mps=0.12)


async def _lets_go(rig: RobotRig, driving: Driving) -> None:
    driving.motion = Motion()


async def _planner_dies(rig: RobotRig, driving: Driving) -> None:
    await rig.kill("planning")


async def _emergency_stop(rig: RobotRig, driving: Driving) -> None:
    await rig.estop(latched=True)


@pytest.mark.parametrize("lose", [_lets_go, _planner_dies, _emergency_stop], ids=lambda lose: lose.__name__)
def test_driven_obliquely_it_goes_there_and_is_at_rest_in_time(
    lose: Callable[[RobotRig, Driving], Awaitable[None]],
) -> None:
    @in_virtual_time
    async def lost() -> None:
        async with RobotRig(robot=omni_robot()) as rig:
            driving = Driving(rig.operator, await rig.begin("drive"))
            await driving.__aenter__()
            for _ in range(75):
                driving.motion = OBLIQUE
                await rig.advance(0.04)
            x, y, _ = rig.truths[-1].body_m
            assert x > 0.3
            assert y == pytest.approx(x * 0.12 / 0.18, rel=0.05)
            command = rig.tap.messages(topics.BASE_COMMAND)[-1]
            assert (command.ahead_mps, command.aside_mps) == pytest.approx((0.18, 0.12))
            since_s = rig.now_s
            await lose(rig, driving)
            await rig.advance(1.0)
            speeds = rig.speeds_since(since_s + 0.45)
            assert max(speeds) < HALTED_MPS
            if driving._work is not None:
                driving._work.cancel()

    lost()


@in_virtual_time
async def test_it_fetches_a_can_as_the_calliope_does() -> None:
    async with RobotRig(robot=omni_robot()) as rig:
        ended = await rig.run("fetch", "red_can")
        assert (ended.outcome, ended.reason) == ("done", "")
        can = rig.thing("red_can")
        assert {"claw_left", "claw_right"} <= set(can.touching)
        assert can.position_m[2] > 0.1
        assert hypot(*rig.truths[-1].body_m[:2]) > 0.3
        assert not {one for truth in rig.truths for one in truth.collisions}
