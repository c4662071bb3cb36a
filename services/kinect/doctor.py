"""The checks of `cocoro doctor` for the Kinect, while its service is down."""

from __future__ import annotations

import asyncio
from contextlib import closing

from cocoro.checks import Check, bad, note, ok
from cocoro.clock import RealClock
from cocoro.errors import ConfigError
from cocoro.robot import Robot
from services.kinect.camera import open_device
from services.kinect.device import KinectConfig

__all__ = ["check"]

LOOK_S = 4.0


def check(config: KinectConfig, robot: Robot, robot_name: str) -> list[Check]:
    """Check whether frames come from the device, and whether its lenses were measured."""
    checks = [asyncio.run(_look(config))]
    if robot.eye.depth_lens is None:
        checks.append(note("Kinect's lenses", "not measured: `cocoro kinect calibrate`"))
    else:
        checks.append(ok("Kinect's lenses", "measured"))
    return checks


async def _look(config: KinectConfig) -> Check:
    faults: list[str] = []
    try:
        camera = open_device(config, RealClock(), faults.append)
    except ConfigError as error:
        return bad("Kinect", str(error).removeprefix("kinect: "))
    with closing(camera):
        try:
            async with asyncio.timeout(LOOK_S):
                async for frame in camera.frames():
                    height, width = frame.depth.shape
                    seen = float((frame.depth < 2047).mean())
                    return ok("Kinect", f"sends pictures, {width} x {height}, depth in {100 * seen:.0f}% of them")
        except TimeoutError:
            pass
    return bad("Kinect", faults[-1] if faults else "sends no pictures")
