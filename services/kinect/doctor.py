"""The checks of `cocoro doctor` for the Kinect or another camera, while its service is down."""

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
    """Check whether frames come from the device, with depth where the robot's description says so, and whether its
    lenses were measured."""
    checks = [asyncio.run(_look(config, robot))]
    lens, name = (robot.eye.depth_lens, "Kinect's lenses") if robot.sees_depth else (robot.eye.colour_lens, "lens")
    if lens is not None:
        checks.append(ok(name, "measured"))
    elif robot.sees_depth:
        checks.append(note(name, "not measured: `cocoro kinect calibrate`"))
    else:
        checks.append(note(name, f"not measured: `colour_lens` of the camera {robot.eye.name} in the robot's own file"))
    return checks


async def _look(config: KinectConfig, robot: Robot) -> Check:
    name = "Kinect" if config.device == "freenect" else "camera"
    faults: list[str] = []
    try:
        camera = open_device(config, RealClock(), faults.append)
    except ConfigError as error:
        return bad(name, str(error).removeprefix("kinect: "))
    with closing(camera):
        try:
            async with asyncio.timeout(LOOK_S):
                async for frame in camera.frames():
                    height, width = frame.colour.shape[:2]
                    told = f"sends pictures, {width} x {height}"
                    if (frame.depth is not None) != robot.sees_depth:
                        has = "without" if frame.depth is None else "with"
                        said = robot.eye.depth
                        return bad(name, f"{told}, {has} depth, but the description has depth = {said!r} for it")
                    if frame.depth is None:
                        return ok(name, f"{told}, without depth, {getattr(camera, 'stamps', 'stamps by arrival')}")
                    seen = float((frame.depth < robot.eye.no_depth_code).mean())
                    return ok(name, f"{told}, depth in {100 * seen:.0f}% of them")
        except TimeoutError:
            pass
    return bad(name, faults[-1] if faults else "sends no pictures")
