"""Records a simulated Kinect for libfreenect's playback library, fakenect: `python -m sim.wire.record FOLDER`.

The robot stands still in its scene, with its head at the given angles. Beside the recording, truth.json has the places
of the objects in the robot's frame, and the head's angles.

The format follows fakenect's README: a folder with a file for each observation, named TYPE-SECONDS-TICKS. TYPE is r for
colour, d for depth, a for acceleration; SECONDS is the time of arrival, by which the player paces itself; TICKS is the
device's clock. Colour is a PPM and depth a PGM, with headers of one line; depth is little-endian, as in the device's
buffer, although PGM demands big-endian. Acceleration is the bytes of libfreenect's freenect_raw_tilt_state. INDEX.txt
lists the names, one per line, in the order of playing.
"""

from __future__ import annotations

import argparse
import json
import struct
import sys
from math import radians
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import msgspec
import numpy as np

from cocoro.clock import NS
from cocoro.errors import CocoroError, ConfigError
from cocoro.messages import Frame, ServoCommand
from cocoro.robot import Robot
from sim.rigid import rotation
from sim.service import SimConfig, make_kinect, make_world
from sim.world import World

WIDTH, HEIGHT = 640, 480
TICKS_HZ = 60_000_000
COUNTS_PER_G = 819
LEVEL = struct.pack("<hhhbxi", 0, COUNTS_PER_G, 0, 0, 0)
"""freenect_raw_tilt_state of a level Kinect: x, y, z, tilt angle, tilt status."""


class RecordingWriter:
    """Writes a recording; a context manager. Raises ConfigError when the folder has a recording already, or cannot be
    written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.frames = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._index: TextIO = (folder / "INDEX.txt").open("x", encoding="ascii")
        except FileExistsError:
            raise ConfigError(f"{folder} holds a recording already: name another folder") from None
        except OSError as error:
            raise ConfigError(f"{folder} cannot be written: {error.strerror}") from error

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._index.close()

    def add(self, frame: Frame, at_ns: int | None = None) -> None:
        """Write a frame that was taken at `at_ns` by any clock; by default at its stamp."""
        if (frame.width, frame.height) != (WIDTH, HEIGHT):
            raise ConfigError(f"a Kinect's pictures are {WIDTH} x {HEIGHT}, not {frame.width} x {frame.height}")
        at_ns = frame.stamp_ns if at_ns is None else at_ns
        if self.frames == 0:
            self._write("a", at_ns, LEVEL, "dump")
        self._write("d", at_ns, b"P5 %d %d 65535\n" % (WIDTH, HEIGHT) + frame.depth, "pgm")
        self._write("r", at_ns, b"P6 %d %d 255\n" % (WIDTH, HEIGHT) + frame.colour, "ppm")
        self.frames += 1

    def _write(self, kind: str, at_ns: int, data: bytes, ending: str) -> None:
        ticks = at_ns * TICKS_HZ // NS % (1 << 32)
        name = f"{kind}-{at_ns // NS}.{at_ns % NS // 1000:06d}-{ticks}.{ending}"
        (self.folder / name).write_bytes(data)
        self._index.write(f"{name}\n")


RATE_HZ = 30
TURN_NS = 3 * NS
START_NS = NS
"""Time of the first frame; fakenect takes 0 for no time."""


def record(
    folder: Path, robot: Robot, config: SimConfig, frames: int, *, pan_rad: float = 0.0, tilt_rad: float = 0.0
) -> dict[str, Any]:
    """Write this many frames. Returns the truth: the places of the objects by label, in the body frame, m, and the
    head's angles, rad."""
    config = msgspec.structs.replace(config, width=WIDTH, height=HEIGHT)
    with (
        make_world(robot, config) as world,
        make_kinect(robot, config, world) as kinect,
        RecordingWriter(folder) as writer,
    ):
        _turn_head(world, pan_rad, tilt_rad)
        for number in range(frames):
            at_ns = START_NS + number * NS // RATE_HZ
            writer.add(kinect.capture(world.visual_poses(), world.camera_pose(), at_ns, world.light))
        truth = _truth(world)
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="ascii")
    return truth


def _turn_head(world: World, pan_rad: float, tilt_rad: float) -> None:
    head = world.robot.head_angles(pan_rad, tilt_rad)
    world.set_latch("released")
    while world.time_ns < TURN_NS:
        if world.time_ns < TURN_NS - NS // 2:  # afterwards it holds, and comes to rest
            goals, speeds = tuple(head.values()), (1.5,) * len(head)
            goal = ServoCommand(stamp_ns=world.time_ns, joints=tuple(head), goal_rad=goals, speed_radps=speeds)
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
        "head": {joint: round(truth.joints_rad[joint], 6) for joint in world.robot.head_angles()},
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
    parser.add_argument("--robot", type=Path, metavar="NAME|FILE", help="lekiwi, or the file of a robot's description")
    parser.add_argument("--description", dest="robot", type=Path, help=argparse.SUPPRESS)  # its former spelling
    parser.add_argument("--measured", type=Path, metavar="FILE", help="values that were measured on this robot")
    options = parser.parse_args()
    config = SimConfig(scene=options.scene, seed=options.seed, sensors=options.sensors)
    try:
        record(
            options.folder, Robot.load(options.robot, options.measured), config, round(options.seconds * RATE_HZ),
            pan_rad=radians(options.pan), tilt_rad=radians(options.tilt),
        )  # fmt: skip
    except CocoroError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"FAKENECT_PATH={options.folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
