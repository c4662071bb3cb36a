"""Measures a frame of the simulated Kinect by parts: `python bench/render.py [--frames 640x480] [--rounds 60]`.

The parts take turns in every round, so that a temporary load affects all of them; compare the ratios.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from cocoro.errors import ConfigError
from cocoro.robot import Robot
from sim.camera import SimKinect, moved
from sim.render import make_renderer
from sim.scene import load_scene
from sim.world import World

FRAME_NS = 33_333_333
TURN_RADPS = 0.5
"""Speed of the head for the moving camera: 10 pixels of blur at 640 x 480."""


def parts_of(robot: Robot, world: World, width: int, height: int) -> dict[str, Callable[[], object]]:
    """Every part by its name, to be called repeatedly. The others are compared with the first."""
    camera = robot.camera.scaled(width, height)
    poses, pose, light = world.visual_poses(), world.camera_pose(), world.light
    depth_pose = moved(pose, np.array(robot.kinect.depth_offset_m))
    projector_pose = moved(pose, np.array(robot.kinect.projector_offset_m))
    parts: dict[str, Callable[[], object]] = {}
    try:
        fast = make_renderer(world.visuals, camera, "moderngl")
    except ConfigError as error:
        Console(stderr=True).print(str(error))
        fast = make_renderer(world.visuals, camera, "tiny")
    else:
        ctx = fast._ctx  # type: ignore[attr-defined]

        def drawn(draw: Callable[[], object]) -> None:
            draw()
            ctx.finish()

        parts["colour pass with the lamp's shadows"] = partial(drawn, partial(fast._draw_colour, pose, light))  # type: ignore[attr-defined]
        parts["depth pass"] = partial(drawn, partial(fast._draw_depth, depth_pose, None))  # type: ignore[attr-defined]
        parts["depth pass with infrared shadows"] = partial(
            drawn,
            partial(fast._draw_depth, depth_pose, projector_pose),  # type: ignore[attr-defined]
        )
    parts["render: colour and depth"] = partial(fast.render, poses, pose, depth_pose, light)
    parts["render: and infrared shadows"] = partial(fast.render, poses, pose, depth_pose, light, projector_pose)
    ideal = SimKinect(robot, fast, sensors="ideal", width=width, height=height)
    parts["frame, ideal"] = partial(ideal.capture, poses, pose, 0, light)
    still = SimKinect(robot, fast, sensors="real", width=width, height=height)
    parts["frame, real, camera at rest"] = still_frames(partial(still.capture, poses), pose, light)
    turning = SimKinect(robot, fast, sensors="real", width=width, height=height)
    parts["frame, real, camera turning"] = turning_frames(partial(turning.capture, poses), pose, light)
    slow = make_renderer(world.visuals, camera, "tiny")
    parts["render by TinyRenderer: colour and depth"] = partial(slow.render, poses, pose, depth_pose, light)
    parts["gathering the poses"] = world.visual_poses
    return parts


def still_frames(capture: Callable[..., object], pose: np.ndarray, light: object) -> Callable[[], object]:
    stamps = iter(range(0, 10**15, FRAME_NS))
    return lambda: capture(pose, next(stamps), light)


def turning_frames(capture: Callable[..., object], pose: np.ndarray, light: object) -> Callable[[], object]:
    numbers = iter(range(10**6))

    def one() -> object:
        number = next(numbers)
        angle = TURN_RADPS * number / 30
        c, s = np.cos(angle), np.sin(angle)
        turned = pose.copy()
        turned[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ pose[:3, :3]
        return capture(turned, number * FRAME_NS, light)

    return one


def measure(parts: dict[str, Callable[[], object]], rounds: int) -> dict[str, np.ndarray]:
    """Times of each part, ms, (rounds,)."""
    taken: dict[str, list[float]] = {name: [] for name in parts}
    for round_ in range(rounds + 5):
        for name, part in parts.items():
            if "Tiny" in name and round_ % 10:
                continue
            start = time.perf_counter()
            part()
            if round_ >= 5:
                taken[name].append(1e3 * (time.perf_counter() - start))
    return {name: np.array(times) for name, times in taken.items()}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--frames", action="append", metavar="WxH", help="default: 640x480 and 320x240")
    arguments.add_argument("--rounds", type=int, default=60)
    options = arguments.parse_args()
    robot = Robot.load()
    with World(robot, load_scene("paper")) as world:
        for size in options.frames or ["640x480", "320x240"]:
            width, height = (int(side) for side in size.split("x"))
            taken = measure(parts_of(robot, world, width, height), options.rounds)
            unit = float(np.median(next(iter(taken.values()))))
            table = Table("part", "ms, median", "ms, best", "of the first", title=f"{width} x {height}")
            for name, times in taken.items():
                median = float(np.median(times))
                table.add_row(name, f"{median:.2f}", f"{times.min():.2f}", f"{median / unit:.2f}")
            Console().print(table)


if __name__ == "__main__":
    main()
