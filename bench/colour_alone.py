"""How well colour alone places an object, and fetches by it: the tables of docs/colour-alone.md.

    python -m bench.colour_alone [--size 640x480] [--small] [--views 24]   # error of the place over the distance
    python -m bench.colour_alone --fetch 10 [--size 320x240]               # three small cans, so many seeds each

By the simulator's truth, with the errors of real sensors. `--tilt DEG` tilts the camera by what no description knows.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Sequence
from importlib import resources
from math import cos, hypot, radians, sin
from pathlib import Path

import numpy as np

from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.core import Sample
from cocoro.messages import Detections, ServoState
from cocoro.objects import Catalogue, own_text
from cocoro.robot import Robot
from cocoro.topics import ARM_STATE, FRAME
from services.executive.tasks import FetchTask
from services.perception.config import PerceptionConfig
from services.perception.core import PerceptionCore
from sim.camera import SimKinect
from sim.render import make_renderer
from sim.render.interface import Visual
from sim.scene import Light

ROBOT = "lekiwi-colour"
AWAY_M = (0.4, 0.5, 0.7, 0.9, 1.2, 1.5, 1.8, 2.0)
ASIDE_RAD = 0.35
NS = 1_000_000_000
LABELS = ("red_can", "green_can", "blue_can")


def small(text: str) -> str:
    """The text of a catalogue or a scene with cans of 40 mm by 100 mm, which a LeKiwi's hand takes."""
    return text.replace("radius_m = 0.033", "radius_m = 0.020").replace("height_m = 0.12", "height_m = 0.10")


def place(size: tuple[int, int], catalogue: Catalogue, views: int, tilt_deg: float) -> None:
    """Print the error along the line of sight and across it, and the told standard deviation, for each distance."""
    robot, can, rng = Robot.load(Path(ROBOT)), catalogue["red_can"], np.random.default_rng(1)
    assert can.radius_m is not None
    assert can.height_m is not None
    pose = robot.camera_chain.pose({})
    turn = radians(tilt_deg)
    tilted = pose.copy()
    tilted[:3, :3] = pose[:3, :3] @ [[1, 0, 0], [0, cos(turn), -sin(turn)], [0, sin(turn), cos(turn)]]
    park, width, height = robot.poses["park"], *size
    visuals = [Visual("red_can", "cylinder", (can.radius_m, can.height_m), can.rgb)]
    print("| distance m | found | along mm: mean, deviation, largest | across mm, largest | told mm | doubtful |")
    print("| --- | --- | --- | --- | --- | --- |")
    renderer = make_renderer(visuals, robot.camera.scaled(width, height))
    with SimKinect(robot, renderer, sensors="real", seed=1, width=width, height=height) as camera:
        for number, away_m in enumerate(AWAY_M):
            along, across, told, notes = [], [], [], Counter[str]()
            for view in range(views):
                stamp_ns = NS * (1 + number * views + view)
                bearing = rng.uniform(-ASIDE_RAD, ASIDE_RAD)
                x, y = away_m * cos(bearing), away_m * sin(bearing)
                where = np.eye(4)[None].copy()
                where[0, :3, 3] = x, y, can.height_m / 2
                frame = camera.capture(where, tilted, stamp_ns, Light())
                still = (0.0,) * len(park)
                arm = ServoState(
                    stamp_ns=stamp_ns, joints=tuple(park), position_rad=tuple(park.values()), speed_radps=still,
                    load=still,
                )  # fmt: skip
                core = PerceptionCore(robot, PerceptionConfig(), catalogue)
                (seen, *_) = core.step([Sample(ARM_STATE, arm), Sample(FRAME, frame)], stamp_ns)
                assert isinstance(seen.message, Detections)
                for one in seen.message.detections:
                    if one.label == "red_can" and one.position_m is not None and one.sigma_m is not None:
                        ray = np.array([x - pose[0, 3], y - pose[1, 3]])
                        off = np.array([one.position_m[0] - x, one.position_m[1] - y])
                        ray /= hypot(*ray)
                        along.append(1e3 * float(off @ ray))
                        across.append(1e3 * abs(float(off @ [-ray[1], ray[0]])))
                        told.append(1e3 * one.sigma_m)
                        notes[one.note] += 1
            doubtful = len(along) - notes[""]
            numbers = np.array(along)
            print(
                f"| {away_m:g} | {len(along)} of {views} | {numbers.mean():.1f}, {numbers.std():.1f},"
                f" {np.abs(numbers).max():.1f} | {max(across):.1f} | {np.mean(told):.0f} | {doubtful} |"
            )


def fetch(size: tuple[int, int], seeds: int) -> None:
    """Fetch each of three small cans, which stand as the paper's do, in so many scattered scenes."""
    ended: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        scene, objects = Path(folder) / "scene.toml", Path(folder) / "objects.toml"
        scene.write_text(small(resources.files("sim.scenes").joinpath("paper.toml").read_text(encoding="utf-8")))
        objects.write_text(small(own_text()))
        for seed in range(1, seeds + 1):
            for label in LABELS:
                result = rehearse(
                    RehearsalRequest(
                        task=FetchTask(label=label), scene=str(scene), description=ROBOT, objects=str(objects),
                        seed=seed, sensors="real", width=size[0], height=size[1], frame_rate_hz=15.0,
                    )
                )  # fmt: skip
                truth = result["truth"]
                good = result["outcome"] == "done" and truth["held"] and not truth["collisions"]
                ended["good" if good else result["reason"] or "not held"] += 1
                print(f"{seed} {label}: {'held' if good else result['reason']}", flush=True)
    print(f"{ended.pop('good', 0)} of {3 * seeds} fetched; else {dict(ended) or 'nothing'}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.colour_alone", description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--small", action="store_true", help="a can of 40 mm by 100 mm")
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--tilt", type=float, default=0.0, metavar="DEG")
    parser.add_argument("--fetch", type=int, default=0, metavar="SEEDS")
    options = parser.parse_args(arguments)
    width, height = (int(side) for side in options.size.split("x"))
    if options.fetch:
        fetch((width, height), options.fetch)
        return
    text = small(own_text()) if options.small else own_text()
    place((width, height), Catalogue.from_text(text, "the catalogue"), options.views, options.tilt)


if __name__ == "__main__":
    main()
