"""What a wrong clock does to a localised target: `python -m bench clocks [--jobs 2]`.

Rehearsals of fetches (the head sweeps, the base turns and drives to a can) and of pursuits (a ball is carried round at
0.15 to 0.30 m/s) are recorded with real sensors. Each detection is then placed in odometry as the robot does it, once
with the head angles and the odometry of its frame's stamp, and once with those of a later time, as if the camera's
clock were behind that of joints and base by so much. Both are the same but for the time: the distance between the two
places is the error.
"""

from __future__ import annotations

import argparse
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from apps.rehearsal.request import RehearsalRequest
from bench.pursuit import LABEL, travels
from bench.report import Report
from bench.trials import Runs, add_frames, add_jobs, sized
from cocoro import topics
from cocoro.arrays import FloatArray
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.robot import Robot
from services.executive.tasks import FetchTask

ERRORS_MS = (0, 5, 10, 20, 50)
CAN = "red_can"
FAST_RADPS = 0.8
"""From this speed of the camera on a sighting counts as made while turning fast; the robot's fastest turn is 1.6."""
FAST_MPS = 0.3
"""From this speed of the base on it counts as made while driving fast; the robot's highest is 0.48."""
SPEED_NS = NS // 20
"""Time over which the camera's turn is measured."""


class Sighting(NamedTuple):
    """A detection with a position, and what the error of each injected time is."""

    turn_radps: float
    """Of the camera, in odometry."""
    speed_mps: float
    distance_m: float
    errors_m: tuple[float, ...]


class Track:
    """Values over time, interpolated."""

    def __init__(self, rows: list[tuple[int, tuple[float, ...]]]) -> None:
        self._stamps = np.array([stamp for stamp, _ in rows], dtype=float)
        self._values = np.array([values for _, values in rows])

    def covers(self, at_ns: int) -> bool:
        return bool(self._stamps[0] <= at_ns <= self._stamps[-1])

    def at(self, at_ns: int) -> FloatArray:
        return np.array([np.interp(at_ns, self._stamps, column) for column in self._values.T])


def sightings(capture: Path, label: str) -> list[Sighting]:
    """The sightings of an object in a capture."""
    robot = Robot.load()
    chain = robot.camera_chain
    heads: list[tuple[int, tuple[float, ...]]] = []
    bodies: list[tuple[int, tuple[float, ...]]] = []
    seen: list[tuple[int, tuple[float, ...]]] = []
    rows = (topics.ARM_STATE, topics.BASE_STATE, topics.DETECTIONS)
    with Capture.open(capture) as opened:
        for record in opened.messages(*(row.name for row in rows)):
            message: Any = opened.read(record)
            if record.key.endswith(topics.ARM_STATE.name):
                angles = dict(zip(message.joints, message.position_rad, strict=True))
                heads.append((message.stamp_ns, tuple(angles[joint] for joint in chain.joints)))
            elif record.key.endswith(topics.BASE_STATE.name):
                bodies.append((message.stamp_ns, (*message.odometry_m, message.odometry_yaw_rad, message.speed_mps)))
            else:
                seen += [
                    (message.stamp_ns, found.position_m)
                    for found in message.detections
                    if found.label == label and found.position_m is not None and not found.note
                ]
    head, body = Track(heads), Track(bodies)

    def camera(at_ns: int) -> FloatArray:
        """The camera's pose in the body frame."""
        return chain.pose(dict(zip(chain.joints, head.at(at_ns).tolist(), strict=True)))

    def placed(in_camera: FloatArray, at_ns: int) -> FloatArray:
        x, y, z = (camera(at_ns) @ in_camera)[:3]
        pose = Pose2(*body.at(at_ns)[:3].tolist())
        return np.array(pose.apply((float(x), float(y), float(z))))

    def bearing_rad(at_ns: int) -> float:
        """Direction of the optical axis in odometry."""
        axis = camera(at_ns)[:3, 2]
        return float(np.arctan2(axis[1], axis[0]) + body.at(at_ns)[2])

    found = []
    for stamp_ns, position in seen:
        if not all(track.covers(stamp_ns + by) for track in (head, body) for by in (0, 2 * SPEED_NS)):
            continue
        in_camera = np.linalg.inv(camera(stamp_ns)) @ np.array([*position, 1.0])
        right = placed(in_camera, stamp_ns)
        errors = [
            float(np.linalg.norm(placed(in_camera, stamp_ns + error * NS // 1000) - right)) for error in ERRORS_MS
        ]
        turned = bearing_rad(stamp_ns + SPEED_NS) - bearing_rad(stamp_ns)
        turned = (turned + np.pi) % (2 * np.pi) - np.pi
        found.append(
            Sighting(
                abs(turned) * NS / SPEED_NS,
                abs(float(body.at(stamp_ns)[3])),
                float(np.linalg.norm(position[:2])),
                tuple(errors),
            )
        )
    return found


def _run(request: RehearsalRequest) -> dict[str, Any]:
    from apps.rehearsal.rehearse import rehearse

    return rehearse(request)


def options(parser: argparse.ArgumentParser) -> None:
    add_frames(parser, "320x240@30")
    add_jobs(parser)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    fetches, pursuits = sized(chosen, None, (4, 2), (1, 0))
    runs = Runs(report)
    found: list[Sighting] = []
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(chosen.jobs, max_tasks_per_child=1) as pool:
        requests, labels = [], []
        for label, seed in [(CAN, seed) for seed in range(fetches)] + [(LABEL, seed) for seed in range(pursuits)]:
            file = Path(folder) / f"{label}-{seed}"
            fields: dict[str, Any] = {"task": FetchTask(label=CAN)}
            if label == LABEL:
                text, fields = travels(seed)
                file.with_suffix(".toml").write_text(text)
                fields["scene"] = str(file.with_suffix(".toml"))
            record = str(file.with_suffix(".mcap"))
            requests.append(RehearsalRequest(seed=seed, sensors="real", record=record, **chosen.frames, **fields))
            labels.append(label)
        for request, label, result in zip(requests, labels, pool.map(_run, requests), strict=True):
            some = sightings(Path(str(request.record)), label)
            runs.add(result["outcome"] == "done", f"{label} seed {request.seed}: {len(some)} sightings")
            found += some
    runs.share("rehearsals that were done")
    groups = {
        "all sightings": found,
        f"camera turns at {FAST_RADPS:g} rad/s or more": [one for one in found if one.turn_radps >= FAST_RADPS],
        f"base drives at {FAST_MPS:g} m/s or more": [one for one in found if one.speed_mps >= FAST_MPS],
    }
    for name, group in groups.items():
        if not group:
            report.say(f"{name}: none")
            continue
        report.value(f"{name}: distance", [one.distance_m for one in group], "m")
        for number, error in enumerate(ERRORS_MS):
            off_mm = [1e3 * one.errors_m[number] for one in group]
            report.value(f"{name}: {error} ms", off_mm, "mm")
            report.value(f"{name}: {error} ms, worst of 100", [float(np.percentile(off_mm, 99))], "mm")
