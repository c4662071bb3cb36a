"""Every component speaks as it declares: what it subscribes to, publishes, serves and calls equals its declaration."""

from __future__ import annotations

from pathlib import Path

import pytest
from robot_rig import SMALL_FRAMES, RobotRig

from cocoro import topics
from cocoro.learning import model
from cocoro.messages import ModelRequest
from cocoro.robot import Robot
from cocoro.testing import in_virtual_time, misdeclared
from cocoro.topics import HAND_SAMPLES, WHEEL_TRIALS
from deploy import processes

SIMULATED = ("capture", "sim", "perception", "planning", "executive")


@pytest.mark.sim
@in_virtual_time
async def test_the_simulated_robot_speaks_as_it_declares(tmp_path: Path) -> None:
    """Over all that makes a component say something: recording, both kinds of babbling, a learned model."""
    settings = {"capture": {"file": str(tmp_path / "all.mcap")}, "sim": SMALL_FRAMES | {"scene": "wheels"}}
    async with RobotRig(services=SIMULATED, settings=settings, record_steps=True) as rig:
        for task, label, topic in (("babble-arm", "", HAND_SAMPLES), ("babble-wheels", "red_can", WHEEL_TRIALS)):
            task_id = await rig.begin(task, label)
            await rig.until(lambda topic=topic: topic.name in rig.bus("planning").publishes, 120.0)
            await rig.cancel()
            await rig.outcome(task_id)
        content = model.encode(model.empty(Robot.load()))
        assert (await rig.operator.call(topics.LEARNED, ModelRequest(content=content))).accepted
        await rig.advance(0.5)
        found = {name: misdeclared(processes.named(name), rig.bus(name)) for name in SIMULATED}
    assert found == dict.fromkeys(SIMULATED, [])
