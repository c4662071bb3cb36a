"""The simulator: how fast rehearsals are, where their processor time goes, and a physics step beside MuJoCo's.

    python -m bench simulator [--short] [--json]

A rehearsal is the whole process, from its start to its end with imports: `fetch red_can` in the paper's scene, with the
camera's pictures drawn in a process of their own (as `cocoro rehearse` does), and in turns in the process itself. Its
real-time factor is the simulated time of the run by the time of the process.

A frame is what `SimKinect.capture` takes in one process: rendered, and made what the sensor would deliver.

The split is that of one process that draws its pictures in its own thread. Each part has the time of its own functions
without that of the other parts' functions that they call. MuJoCo (`pip install mujoco`) steps the same links, masses,
shapes and scene with its own solver; where it is not installed, that comparison is left out, and the result says so.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Callable
from contextlib import ExitStack
from itertools import count as count_up
from pathlib import Path
from typing import Any

from bench.report import Report, Table, timed, turns
from bench.simulator_split import PARTS
from cocoro.clock import NS
from cocoro.kinematics import turn_z
from cocoro.robot import Robot
from sim.camera import SimKinect
from sim.kinds import Sensors
from sim.render import make_renderer
from sim.scene import load_scene
from sim.world import World

ROOT = Path(__file__).parents[1]
VARIANTS: dict[str, dict[str, Any]] = {
    "640 x 480 at 30 Hz": {},
    "640 x 480 at 30 Hz, real sensors": {"sensors": "real"},
    "320 x 240 at 15 Hz": {"width": 320, "height": 240, "frame_rate_hz": 15.0},
}
ROUNDS, SHORT_ROUNDS = 5, 1
FRAMES, SHORT_FRAMES = 60, 10
STEPS, SHORT_STEPS = 2000, 300
PHYSICS_HZ = 240
FRAME_HZ = 30
TURN_RADPS = 0.5
"""Speed of a turning camera: 10 pixels of blur."""
LONGEST_S = 120.0


def measure(chosen: Namespace, report: Report) -> None:
    rounds = SHORT_ROUNDS if chosen.short else ROUNDS
    for name, request in VARIANTS.items():
        beside, inside = turns(
            rounds, 0 if chosen.short else 1, beside=rehearsal(request, True), inside=rehearsal(request, False)
        )
        report.value(f"{name}: real-time factor", [sim_s / wall_s for sim_s, wall_s in beside], "times real time")
        report.ratio(
            f"{name}: pictures drawn in the process / in one of their own",
            [wall_s for _, wall_s in inside],
            [wall_s for _, wall_s in beside],
            better="more",
        )
    report.tables.append(split_table())
    frames(report, SHORT_FRAMES if chosen.short else FRAMES)
    physics(report, SHORT_STEPS if chosen.short else STEPS)


def rehearsal(request: dict[str, Any], camera_process: bool) -> Callable[[], tuple[float, float]]:
    """A function that runs a rehearsal as a process and returns its simulated and its real time, s."""

    def run() -> tuple[float, float]:
        begun_s = time.perf_counter()
        result = _asked("bench.simulator_run", json.dumps({**request, "camera_process": camera_process}))
        return result["sim_s"], time.perf_counter() - begun_s

    return run


def split_table() -> Table:
    """Processor time of each part, in seconds per simulated second and in percent, by variant."""
    rows = [[part] for part in (*PARTS, "all")]
    for request in VARIANTS.values():
        times = _asked("bench.simulator_split", json.dumps(request))
        total = sum(times[part] for part in PARTS)
        for row, part in zip(rows, PARTS, strict=False):
            row.append(f"{times[part] / times['sim_s']:.3f} ({100 * times[part] / total:.0f}%)")
        rows[-1].append(f"{total / times['sim_s']:.3f}")
    return Table("Processor time for each simulated second, s, without start-up", ["part", *VARIANTS], rows)


def frames(report: Report, count: int) -> None:
    """The time of a frame of 640 x 480: ideal, and real with the camera at rest and turning, as the head does."""
    robot = Robot.load()
    with World(robot, load_scene("paper")) as world, ExitStack() as stack:

        def camera(sensors: Sensors, turn_radps: float = 0.0) -> Callable[[], float]:
            kinect = stack.enter_context(SimKinect(robot, make_renderer(world.visuals, robot.camera), sensors=sensors))
            poses, pose, numbers = world.visual_poses(), world.camera_pose(), count_up()

            def take() -> object:
                number = next(numbers)
                turned = pose.copy()
                turned[:3, :3] = turn_z(turn_radps * number / FRAME_HZ)[:3, :3] @ pose[:3, :3]
                return kinect.capture(poses, turned, round(number * NS / FRAME_HZ), world.light)

            return timed(take)

        ideal, still, turning = turns(
            count, 3, ideal=camera("ideal"), still=camera("real"), turning=camera("real", TURN_RADPS)
        )
    report.value("frame, 640 x 480, ideal", ideal, "ms")
    report.value("frame, real sensors, at rest", still, "ms")
    report.value("frame, real sensors, turning", turning, "ms")
    report.ratio("frame: real and turning / ideal", turning, ideal, better="less")


def physics(report: Report, steps: int) -> None:
    """The time of a physics step with the robot at rest in the paper's scene."""
    robot, scene = Robot.load(), load_scene("paper")
    with World(robot, scene, physics_hz=PHYSICS_HZ) as world:
        for _ in range(PHYSICS_HZ):
            world.step()
        bullet = timed(world._bullet.stepSimulation, "us")
        whole = timed(world.step, "us")
        try:
            from bench.mujoco_world import stepper

            mujoco = timed(stepper(robot, scene, PHYSICS_HZ), "us")
        except ImportError:
            ours, world_us = turns(steps, ours=bullet, whole=whole)
            report.notes.append("MuJoCo is not installed (pip install 'cocoro-mesh[bench]'): no comparison with it.")
        else:
            ours, world_us, theirs = turns(steps, ours=bullet, whole=whole, theirs=mujoco)
            report.value("MuJoCo's step of the same scene", theirs, "us")
            report.ratio("PyBullet's step / MuJoCo's", ours, theirs, better="less")
    report.value("physics step of PyBullet", ours, "us")
    report.value("step of the world: physics, motors and sensors", world_us, "us")


def _asked(module: str, argument: str) -> Any:
    """What a module prints as JSON when it is run with one argument. Raises CalledProcessError with its errors."""
    done = subprocess.run(
        [sys.executable, "-m", module, argument],
        capture_output=True, text=True, check=True, timeout=LONGEST_S, cwd=ROOT, env=os.environ,
    )  # fmt: skip
    return json.loads(done.stdout)
