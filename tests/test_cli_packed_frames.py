"""The bus of commands over a site: frames come unpacked to who subscribes to them, by whatever key expression."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from apps.client.packed_frames import unpacking
from cocoro.bus.base import Payload, Qos
from cocoro.bus.local import LocalMesh
from cocoro.clock import VirtualClock
from cocoro.messages import Frame
from cocoro.node import Node
from cocoro.participant import Participant
from cocoro.robot import Robot
from cocoro.topics import BASE_STATE, FRAME
from cocoro.vloop import run_virtual
from services.frames import packer

FRAME_KEY, STATE_KEY = FRAME.key("calliope"), BASE_STATE.key("calliope")


@pytest.mark.parametrize(
    ("keyexpr", "expected"),
    [("calliope/**", {FRAME_KEY, STATE_KEY}), (FRAME_KEY, {FRAME_KEY}), (STATE_KEY, {STATE_KEY})],
)
def test_a_subscription_gets_frames_where_its_expression_matches_their_key(keyexpr: str, expected: set[str]) -> None:
    async def scenario() -> None:
        robot, clock, near, far = Robot.load(), VirtualClock(), LocalMesh(), LocalMesh()
        async with Node("kinect", near.join(), clock, robot) as kinect, Node("packer", near.join(), clock, robot) as by:
            task = asyncio.create_task(packer.run(by, packer.PackerConfig()))
            command = Participant(far.join(), clock, "calliope")
            far_base = far.join().publisher(STATE_KEY, Qos.STATE)
            heard: list[tuple[str, Payload]] = []
            bus = unpacking(command.bus, "calliope", by, best=True)
            subscription = bus.subscribe(
                keyexpr,
                Qos.STATE,
                lambda key, data: heard.append((key, data)) if "health" not in key else None,
                depth=8,
            )
            await asyncio.sleep(0.3)
            for number in range(5):
                depth = np.full(16, number, "<u2").view(np.uint8).tobytes()
                kinect.publish(FRAME, Frame(width=4, height=4, colour=memoryview(bytes(48)), depth=memoryview(depth)))
                far_base.put(b"a state")
                await asyncio.sleep(0.1)
            assert {key for key, _ in heard} == expected
            count = len(heard)
            subscription.close()
            kinect.publish(FRAME, Frame(width=4, height=4, colour=memoryview(bytes(48)), depth=memoryview(bytes(32))))
            far_base.put(b"a state")
            await asyncio.sleep(1.0)
            assert len(heard) == count
            assert bus.where == command.bus.where
            task.cancel()

    run_virtual(scenario())
