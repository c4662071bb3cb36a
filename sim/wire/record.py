"""Record what a simulated Kinect sees, for libfreenect's playback library: `python -m sim.wire.record FOLDER`.

The robot stands still in its scene, with its head turned as is said. Beside the recording, truth.json tells where the
objects stand in the robot's frame, and the head's angles.
"""

from __future__ import annotations

import argparse
import json
import sys
from math import radians
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from cocoro.clock import NS
from cocoro.errors import CocoroError
from cocoro.messages import ServoCommand
from cocoro.robot import Robot
from sim.rigid import rotation
from sim.service import SimConfig, make_kinect, make_world
from sim.wire.recording import HEIGHT, WIDTH, RecordingWriter
from sim.world import World

RATE_HZ = 30
HEAD = ("neck_pan", "neck_tilt")
TURN_NS = 3 * NS
START_NS = NS
"""fakenect takes a time of 0 for none at all."""


def record(
    folder: Path, robot: Robot, config: SimConfig, frames: int, *, pan_rad: float = 0.0, tilt_rad: float = 0.0
) -> dict[str, Any]:
    """Write so many frames; where the objects are, by label, in the body frame, and the head's angles."""
    config = msgspec.structs.replace(config, width=WIDTH, height=HEIGHT)
    with make_world(robot, config) as world, RecordingWriter(folder) as writer:
        kinect = make_kinect(robot, config, world)
        _turn_head(world, pan_rad, tilt_rad)
        for number in range(frames):
            at_ns = START_NS + number * NS // RATE_HZ
            writer.add(kinect.capture(world.visual_poses(), world.camera_pose(), at_ns, world.light))
        told = _truth(world)
    (folder / "truth.json").write_text(json.dumps(told, indent=1) + "\n", encoding="ascii")
    return told


def _turn_head(world: World, pan_rad: float, tilt_rad: float) -> None:
    world.set_latch("released")
    while world.time_ns < TURN_NS:
        if world.time_ns < TURN_NS - NS // 2:  # then it holds, and comes to rest
            goal = ServoCommand(
                stamp_ns=world.time_ns, joints=HEAD, goal_rad=(pan_rad, tilt_rad), speed_radps=(1.5, 1.5)
            )
            world.command_servos("arm", goal)
        world.step()


def _truth(world: World) -> dict[str, Any]:
    truth = world.truth()
    turn, origin = rotation(truth.body_orientation), np.array(truth.body_m)
    return {
        "objects": {
            one.label: ((np.array(one.position_m) - origin) @ turn).round(6).tolist()
            for one in truth.objects
            if one.kind == "object"
        },
        "head": {joint: round(truth.joints_rad[joint], 6) for joint in HEAD},
    }


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m sim.wire.record", description="Record for fakenect.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sensors", choices=("ideal", "real"), default="real")
    parser.add_argument("--pan", type=float, default=0.0, metavar="DEG")
    parser.add_argument("--tilt", type=float, default=-25.0, metavar="DEG")
    options = parser.parse_args()
    config = SimConfig(scene=options.scene, seed=options.seed, sensors=options.sensors)
    try:
        record(
            options.folder, Robot.load(), config, round(options.seconds * RATE_HZ),
            pan_rad=radians(options.pan), tilt_rad=radians(options.tilt),
        )  # fmt: skip
    except CocoroError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"FAKENECT_PATH={options.folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
