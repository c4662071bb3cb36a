"""Measures perception's time per frame: the default detector against the paper's, in one run, on one core.

    python -m bench.perception [--frames N] [--json]

All six known objects stand in a rendered scene with the real sensors' faults. `step` is the service's work for a
frame: decode to arrays, detect, localise. Compare within a run; the absolute figures depend on the machine.
"""

from __future__ import annotations

import argparse
import json
import time
from statistics import median

import cv2
import numpy as np

from cocoro.core import Sample
from cocoro.messages import Frame, ServoState
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import ARM_STATE, FRAME
from services.perception.config import PerceptionConfig
from services.perception.core import PerceptionCore
from sim.camera import SimKinect
from sim.render import make_renderer
from sim.render.interface import Visual
from sim.scene import Light

PLACES = {
    "red_can": (1.5, 0.0, 0.06),
    "green_can": (1.6, -0.5, 0.06),
    "blue_can": (1.0, 0.4, 0.06),
    "yellow_ball": (1.1, 0.1, 0.03),
    "blue_ball": (1.3, -0.15, 0.04),
    "hand_marker": (0.9, -0.1, 0.10),
}
PAN, TILT = 0.0, -0.45
PERIOD_NS = 33_333_333


def frames(robot: Robot, catalogue: Catalogue, size: tuple[int, int], count: int) -> list[Frame]:
    """Frames of the scene, each with different noise."""
    visuals, poses = [], np.tile(np.eye(4), (len(PLACES), 1, 1))
    for pose, (label, place) in zip(poses, PLACES.items(), strict=True):
        known = catalogue[label]
        assert known.radius_m is not None
        shape_size = (known.radius_m,) if known.height_m is None else (known.radius_m, known.height_m)
        visuals.append(Visual(label, known.shape, shape_size, known.rgb))
        pose[:3, 3] = place
    renderer = make_renderer(visuals, robot.camera.scaled(*size))
    kinect = SimKinect(robot, renderer, sensors="real", seed=1, width=size[0], height=size[1])
    head = robot.chain("camera").pose({"neck_pan": PAN, "neck_tilt": TILT})
    taken = [kinect.capture(poses, head, (number + 1) * PERIOD_NS, Light()) for number in range(count)]
    renderer.close()
    return taken


def step_ms(core: PerceptionCore, frame: Frame) -> tuple[float, int]:
    """Time of one step with a frame whose head angles are known, ms, and the number of localised objects."""
    neck = [
        ServoState(
            stamp_ns=frame.stamp_ns + offset,
            joints=("neck_pan", "neck_tilt"),
            position_rad=(PAN, TILT),
            speed_radps=(0.0, 0.0),
            load=(0.0, 0.0),
        )
        for offset in (-PERIOD_NS // 4, PERIOD_NS // 4)
    ]
    inputs = [*(Sample(ARM_STATE, state) for state in neck), Sample(FRAME, frame)]
    start = time.perf_counter()
    outputs = core.step(inputs, frame.stamp_ns + PERIOD_NS)
    taken_ms = (time.perf_counter() - start) * 1e3
    found = outputs[0].message.detections  # type: ignore[attr-defined]
    return taken_ms, sum(detection.position_m is not None for detection in found)


def measure(size: tuple[int, int], count: int) -> dict[str, object]:
    robot, catalogue = Robot.load(), Catalogue.load()
    shown = frames(robot, catalogue, size, count + 3)
    configs = {
        name: PerceptionConfig(detector=name, floor_rate_hz=1e-3) for name in ("blob", "paper")
    }  # no floor scans
    cores = {name: PerceptionCore(robot, config, catalogue) for name, config in configs.items()}
    times: dict[str, list[float]] = {name: [] for name in cores}
    placed: dict[str, int] = dict.fromkeys(cores, 0)
    for number, frame in enumerate(shown):
        for name, core in cores.items():  # in turn, so that the machine's other work affects both alike
            taken_ms, found = step_ms(core, frame)
            if number >= 3:
                times[name].append(taken_ms)
                placed[name] += found
    blob, paper = median(times["blob"]), median(times["paper"])
    return {
        "size": f"{size[0]}x{size[1]}",
        "frames": count,
        "blob_ms": round(blob, 2),
        "paper_ms": round(paper, 2),
        "paper_over_blob": round(paper / blob, 2),
        "blob_placed_a_frame": round(placed["blob"] / count, 2),
        "paper_placed_a_frame": round(placed["paper"] / count, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=100, help="measured at each size (100)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    rows = [measure(size, options.frames) for size in ((640, 480), (320, 240))]
    if options.json:
        print(json.dumps(rows))
        return
    print("six objects, one core; median ms a frame")
    for row in rows:
        print(
            f"{row['size']}: blob {row['blob_ms']} ms ({row['blob_placed_a_frame']} of 6 placed), "
            f"paper {row['paper_ms']} ms ({row['paper_placed_a_frame']}), ratio {row['paper_over_blob']}"
        )


if __name__ == "__main__":
    main()
