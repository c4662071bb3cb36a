"""Every component speaks as it declares: what it subscribes to, publishes, serves and calls equals its declaration."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robot_rig import SMALL_FRAMES, RobotRig
from spelled import idle
from wire_base import Bench as CreateBench
from wire_servos import REPLY_S, ServoBench

from cocoro import topics
from cocoro.clock import FollowedClock, RealClock
from cocoro.learning import model
from cocoro.messages import ModelRequest
from cocoro.robot import Robot
from cocoro.testing import ServiceUnderTest, in_virtual_time, misdeclared
from cocoro.topics import (
    ARM_STATE,
    BASE_STATE,
    FLOOR_PLAN,
    FRAME,
    HAND_SAMPLES,
    HAND_STATE,
    INTENT,
    PLAN,
    RUN,
    TRUTH,
    WHEEL_TRIALS,
)
from deploy import processes
from services.base.component import BASE
from services.kinect import camera
from services.kinect.component import KINECT
from services.kinect.device import RawFrame
from services.kinect.freenect import LED
from services.planning.component import PLANNING
from services.servos.component import SERVOS
from sim.wire.component import WIRE

PATIENCE_S, LOOK_S = 60.0, 0.02
SIMULATED = ("capture", "sim", "perception", "planning", "executive")


@pytest.mark.sim
@in_virtual_time
async def test_the_simulated_robot_speaks_as_it_declares(tmp_path: Path) -> None:
    """The runs include all that makes a component say something: recording, both kinds of babbling, a learned model."""
    settings: dict[str, dict[str, Any]] = {
        "capture": {"file": str(tmp_path / "all.mcap")}, "sim": SMALL_FRAMES | {"scene": "wheels"},
    }  # fmt: skip
    runs: tuple[tuple[str, str, str], ...] = (
        ("babble-arm", "", HAND_SAMPLES.name), ("babble-wheels", "red_can", WHEEL_TRIALS.name),
    )  # fmt: skip
    async with RobotRig(services=SIMULATED, settings=settings, record_steps=True) as rig:
        rig.tap.leave_out(topics.FRAME)
        for task, label, topic in runs:
            task_id = await rig.begin(task, label)
            await rig.until(partial(rig.bus("planning").publishes.__contains__, topic), 120.0)
            await rig.cancel()
            await rig.outcome(task_id)
        content = model.encode(model.empty(Robot.load()))
        assert (await rig.operator.call(topics.LEARNED, ModelRequest(content=content))).accepted
        await rig.advance(0.5)
        found = {name: misdeclared(processes.named(name), rig.bus(name)) for name in SIMULATED}
    assert found == {name: [] for name in SIMULATED}


async def _until(content: Callable[[], object]) -> None:
    for _ in range(round(PATIENCE_S / LOOK_S)):  # whatever is missing at the end shows as a difference
        if content():
            return
        await asyncio.sleep(LOOK_S)


@pytest.mark.process
@pytest.mark.zenoh
def test_the_base_speaks_as_it_declares(tmp_path: Path) -> None:
    async def scenario() -> list[str]:
        with CreateBench(tmp_path) as bench:
            async with ServiceUnderTest(BASE, {"port": bench.port}, clock=RealClock()) as service:
                await _until(lambda: BASE_STATE.name in service.bus.publishes)
                return misdeclared(BASE, service.bus)

    assert asyncio.run(scenario()) == []


@pytest.mark.zenoh
def test_the_servos_speak_as_they_declare(tmp_path: Path) -> None:
    async def scenario() -> list[str]:
        with ServoBench(tmp_path) as bench:
            ports = {"arm_port": bench.port("arm"), "hand_port": bench.port("hand"), "reply_s": REPLY_S}
            async with ServiceUnderTest(SERVOS, ports, clock=RealClock()) as service:
                await _until(lambda: {ARM_STATE.name, HAND_STATE.name} <= service.bus.publishes)
                return misdeclared(SERVOS, service.bus)

    assert asyncio.run(scenario()) == []


@in_virtual_time
async def test_the_kinect_speaks_as_it_declares(monkeypatch: pytest.MonkeyPatch) -> None:
    class OneFrame:
        """A camera that delivers one frame."""

        async def frames(self) -> AsyncIterator[RawFrame]:
            yield RawFrame(1, np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6), np.uint16))
            await asyncio.Event().wait()

        def tilt(self, angle_rad: float) -> None: ...

        def led(self, led: LED) -> None: ...

        def close(self) -> None: ...

    monkeypatch.setattr(camera, "DRIVERS", {"one": lambda *_: OneFrame()})
    async with ServiceUnderTest(KINECT, {"device": "one"}) as service:
        await service.advance(0.1)
        assert misdeclared(KINECT, service.bus) == []


@pytest.mark.process
@pytest.mark.zenoh
@pytest.mark.sim
@pytest.mark.usefixtures("root")
def test_the_simulator_behind_wires_speaks_as_it_declares() -> None:
    async def scenario() -> list[str]:
        async with ServiceUnderTest(WIRE, SMALL_FRAMES, clock=FollowedClock()) as service:
            await _until(lambda: service.outputs(FRAME))
            return misdeclared(WIRE, service.bus)

    assert asyncio.run(scenario()) == []


@in_virtual_time
async def test_a_component_that_says_more_or_less_than_it_declares_is_found() -> None:
    other = replace(
        PLANNING, reads=(*PLANNING.reads, TRUTH), serves=(), publishes=(PLAN, FLOOR_PLAN), calls=(RUN,), records=True
    )
    async with ServiceUnderTest(other) as service:
        service.feed(INTENT, idle())
        await service.advance(0.1)
        assert misdeclared(other, service.bus) == [
            "it publishes base/command, which it does not declare",
            "it declares that it reads sim/truth, and does not",
            "it serves planning/learned, which it does not declare",
            "it declares that it calls executive/run, and does not",
            "records is declared as True",
        ]
