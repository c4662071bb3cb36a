"""A fetch over a slow link that loses packets between the robot's body and its brain: done, nothing else touched.

In virtual time, with the whole robot, judged by the simulator's truth.
"""

from __future__ import annotations

import pytest
from link_rig import BRAIN, SlowLink
from robot_rig import SMALL_FRAMES, RobotRig

from cocoro import topics
from cocoro.clock import Clock, FollowedClock, VirtualClock
from cocoro.testing import in_virtual_time
from sim.judge import HELD_S, Judge
from sim.random_scene import find_scene

pytestmark = pytest.mark.sim


def followed(name: str) -> Clock:
    """The brain's clock follows the ticks that come over the link, late as they are."""
    return FollowedClock() if name in BRAIN else VirtualClock()


@pytest.mark.usefixtures("real_time")
def test_a_fetch_over_a_link_of_50_ms_that_loses_packets_is_done_and_touches_nothing_else() -> None:
    @in_virtual_time
    async def scenario() -> None:
        link = SlowLink(delay_s=0.05, loss=0.02)
        settings = {"sim": SMALL_FRAMES | {"sensors": "real"}}
        async with RobotRig(bus_of=link.bus, clock_of=followed, settings=settings) as rig:
            judge = Judge(rig.robot, find_scene("paper", 0, "red_can"), "red_can")
            rig.operator.on(topics.TRUTH, judge.feed)
            state = await rig.run("fetch", "red_can")
            await rig.advance(HELD_S + 0.5)
            verdict = judge.result()
            assert (state.outcome, state.reason) == ("done", ""), state
            assert (verdict.held, verdict.knocked_over, verdict.collisions) == (True, (), ())

    scenario()
