"""Random scenes in which a robot drives at full speed: to a distant object, or behind a moving one."""

from __future__ import annotations

import random
from math import cos, pi, sin
from pathlib import Path
from typing import Literal, NamedTuple

from cocoro.tasks import Task
from services.executive.tasks import FetchTask, FollowTask, GoToTask

Drive = Literal["fetch", "go-to", "follow"]
DRIVES: tuple[Drive, ...] = ("fetch", "go-to", "follow")
CANS = ("red_can", "green_can", "blue_can")
BALL = "blue_ball"


class Errand(NamedTuple):
    """A task, and the file of its scene."""

    task: Task
    scene: Path


def draw_errand(drive: Drive, rng: random.Random, folder: Path) -> Errand:
    """Draw a scene for a drive and write it into a folder."""
    scene = folder / "scene.toml"
    if drive == "follow":
        scene.write_text(_walk(rng))
        return Errand(FollowTask(label=BALL, for_s=60.0), scene)
    labels = rng.sample(CANS, k=3)
    text = _can(labels[0], rng.uniform(1.7, 2.6), rng.uniform(-0.5, 0.5))
    for number, label in enumerate(labels[1 : 1 + rng.randrange(3)]):
        side = 1.0 if number else -1.0
        text += _can(label, rng.uniform(1.2, 2.4), side * rng.uniform(0.75, 1.1))
    scene.write_text(text)
    target = labels[0]
    task = FetchTask(label=target) if drive == "fetch" else GoToTask(label=target, distance_m=0.4)
    return Errand(task, scene)


def _can(label: str, distance_m: float, bearing_rad: float) -> str:
    x, y = distance_m * cos(bearing_rad), distance_m * sin(bearing_rad)
    return (
        f'[[object]]\nlabel = "{label}"\nshape = "cylinder"\nradius_m = 0.033\nheight_m = 0.12\n'
        f"position_m = [{x:.3f}, {y:.3f}]\n"
    )


def _walk(rng: random.Random) -> str:
    """A ball that moves away along a winding line, about as fast as the robot can follow."""
    heading = rng.uniform(-0.5, 0.5)
    x, y = 1.2 * cos(heading), 1.2 * sin(heading)
    start = f"[{x:.3f}, {y:.3f}, 0.7]"
    path = []
    for _ in range(12):
        heading += rng.uniform(-pi / 5, pi / 5)
        length_m = rng.uniform(0.5, 1.0)
        x, y = x + length_m * cos(heading), y + length_m * sin(heading)
        path.append(f"[{x:.3f}, {y:.3f}]")
    return (
        f'[[object]]\nlabel = "{BALL}"\nshape = "sphere"\nradius_m = 0.040\nposition_m = {start}\n'
        f"path_m = [{', '.join(path)}]\nspeed_mps = {rng.uniform(0.40, 0.46):.3f}\nfloating = true\n"
    )
