"""The Kinect service with a driver from the test."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import numpy as np
import pytest

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import Clock, VirtualClock
from cocoro.errors import ConfigError
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.vloop import run_virtual
from services.kinect import camera
from services.kinect.device import KinectConfig, OnFault, RawFrame
from services.kinect.freenect import LED
from services.kinect.service import run


class _Two:
    """A camera that yields two frames and then none."""

    def __init__(self, clock: Clock) -> None:
        self.closed = False
        self._clock = clock

    async def frames(self) -> AsyncIterator[RawFrame]:
        for number in (1, 2):
            await self._clock.sleep_until(number * 33_000_000)
            # Not contiguous, as from a driver that flips or crops images.
            colour = np.full((4, 12, 3), number, dtype=np.uint8)[:, ::2]
            yield RawFrame(self._clock.now_ns(), colour, np.full((4, 6), 700 + number, dtype=np.uint16))
        await asyncio.get_running_loop().create_future()

    def tilt(self, angle_rad: float) -> None: ...

    def led(self, led: LED) -> None: ...

    def close(self) -> None:
        self.closed = True


def test_every_pair_is_published_with_its_own_stamp_and_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras: list[_Two] = []

    def open_two(config: KinectConfig, clock: Clock, on_fault: OnFault) -> _Two:
        cameras.append(_Two(clock))
        return cameras[-1]

    monkeypatch.setattr(camera, "DRIVERS", {"two": open_two})

    async def scenario() -> list[tuple[int, int, int]]:
        mesh, clock, robot = LocalMesh(), VirtualClock(), Robot.load()
        async with (
            Node("kinect", mesh.join(), clock, robot) as kinect,
            Node("viewer", mesh.join(), clock, robot) as viewer,
        ):
            stream = viewer.stream(topics.FRAME)
            work = kinect.spawn(run(kinect, KinectConfig(device="two")))
            frames = [await stream.next(), await stream.next()]
            work.cancel()
            await asyncio.wait([work])
            return [
                (frame.stamp_ns, frame.colour[0], int(np.frombuffer(frame.depth, dtype="<u2")[5])) for frame in frames
            ]

    assert run_virtual(scenario()) == [(33_000_000, 1, 701), (66_000_000, 2, 702)]
    assert cameras[0].closed


def test_a_driver_that_is_not_there_is_said_with_what_to_do() -> None:
    with pytest.raises(ConfigError, match=r"no driver 'nonesuch' \(known: .*freenect"):
        camera.open_device(KinectConfig(device="nonesuch"), VirtualClock(), print)
