"""Measures pursuits by the true state: `python -m bench pursuit travels|walls [--seeds 0:20]`.

`travels`: a ball is carried round for 30 s before the robot is asked to follow it for 20 s. Reached: the task is done,
and the robot never stood for longer than 0.3 s while it was off its distance. `walls`: a ball stands or is carried
behind a wall that it is seen beside or above. Reached: the task is done, at least half of the time was with the ball,
and nothing was touched. Real sensors. At least `--least` of the set must be reached.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from math import ceil, cos, sin
from pathlib import Path
from typing import Any

import numpy as np

from apps.rehearsal.request import RehearsalRequest
from bench.report import Report
from bench.trials import Runs, add_frames, add_jobs, number_of, sized, span
from services.executive.tasks import FollowTask

LABEL = "blue_ball"
WAIT_S = 30.0
STOOD_S = 0.3
NEAR_SHARE = 0.5
BALL = """
[[object]]
label = "blue_ball"
shape = "sphere"
radius_m = 0.040
floating = true
position_m = [{0:.3f}, {1:.3f}, {height:.2f}]
"""
PATH = """path_m = [{points}]
speed_mps = {speed:.2f}
path_loop = {loop}
"""
WALL = """
[[obstacle]]
shape = "box"
size_m = [0.1, {width:.2f}, {height:.2f}]
position_m = [{x:.2f}, {y:.2f}]
yaw_rad = {yaw:.2f}
"""


def _ball(places: list[tuple[float, float]], speed: float, height: float, *, loop: bool) -> str:
    first, *others = places
    path = ", ".join(f"[{x:.3f}, {y:.3f}]" for x, y in others)
    text = BALL.format(*first, height=height)
    return text + (PATH.format(points=path, speed=speed, loop=str(loop).lower()) if others else "")


def travels(seed: int) -> tuple[str, dict[str, Any]]:
    """A ball that is carried round a rectangle, from any corner, either way, for ever."""
    rng = np.random.default_rng([seed, 1])
    near, wide = rng.uniform(0.8, 1.3), rng.uniform(1.4, 2.0)
    side = -1.0 if rng.random() < 0.5 else 1.0
    corners = [(near, 0.0), (near + wide, 0.0), (near + wide, side * wide), (near, side * wide)]
    begin = int(rng.integers(4))
    corners = corners[begin:] + corners[:begin]
    if rng.random() < 0.5:
        corners.reverse()
    text = _ball(corners, rng.uniform(0.15, 0.30), rng.uniform(0.55, 0.8), loop=True)
    return text, {"task": FollowTask(label=LABEL, for_s=20.0), "wait_s": WAIT_S}


def walls(seed: int) -> tuple[str, dict[str, Any]]:
    """A ball behind a wall: seen above it, or carried there from beside it."""
    rng = np.random.default_rng([seed, 2])
    x, y, yaw = rng.uniform(0.85, 1.2), rng.uniform(-0.2, 0.2), rng.uniform(-0.3, 0.3)
    width, low = rng.uniform(0.8, 1.4), bool(rng.random() < 0.5)
    height, ball = rng.uniform(0.4, 0.55) if low else rng.uniform(0.75, 1.0), rng.uniform(0.6, 0.7)
    behind = rng.uniform(0.9, 1.2)
    place = x + behind * cos(yaw), y + behind * sin(yaw)
    side = -1.0 if rng.random() < 0.5 else 1.0
    beside = x - 0.05, y + side * (width / 2 + 0.45)
    beyond = x + 0.9, y + side * (width / 2 + 0.35)
    places = [place] if low else [beside, beyond, place]
    text = WALL.format(width=width, height=height, x=x, y=y, yaw=yaw)
    text += _ball(places, rng.uniform(0.15, 0.25), ball, loop=False)
    return text, {"task": FollowTask(label=LABEL, for_s=30.0)}


def _travelled(result: dict[str, Any]) -> bool:
    return bool(result["outcome"] == "done" and result["truth"]["stood_s"] <= STOOD_S)


def _went_round(result: dict[str, Any]) -> bool:
    truth = result["truth"]
    return bool(result["outcome"] == "done" and truth["near_share"] >= NEAR_SHARE and truth["contacts"] == 0)


Make = Callable[[int], tuple[str, dict[str, Any]]]
SETS: dict[str, tuple[Make, Callable[[dict[str, Any]], bool], range, int]] = {
    "travels": (travels, _travelled, range(20), 20),
    "walls": (walls, _went_round, range(10), 8),
}
"""By name: the scene and the task of a seed, what is reached, the usual seeds, and how many of them must be."""


def _run(request: RehearsalRequest) -> dict[str, Any]:
    from apps.rehearsal.rehearse import rehearse

    return rehearse(request)


SHOWN = {
    "stood_s": ("stood while it was off its distance", "s"),
    "near_share": ("share of the time with the ball", "of 1"),
    "mean_gap_m": ("mean gap", "m"),
    "lost_s": ("lost", "s"),
}
"""By the truth's field: what it is called, and its unit."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("set", choices=SETS, nargs="?", default="travels")
    parser.add_argument("--seeds", type=span, metavar="FROM:TO", help="0:20 of travels, 0:10 of walls")
    parser.add_argument("--least", type=number_of, help="that must be reached; of walls 8 of 10, else all")
    add_frames(parser, "320x240@15")
    add_jobs(parser)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    make, good, usual, usual_least = SETS[chosen.set]
    seeds = sized(chosen, chosen.seeds, usual, usual[:1])
    least = chosen.least or ceil(len(seeds) * usual_least / len(usual))
    runs = Runs(report)
    measured: dict[str, list[float]] = {name: [] for name in SHOWN}
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(chosen.jobs, max_tasks_per_child=1) as pool:
        requests = []
        for seed in seeds:
            text, fields = make(seed)
            scene = Path(folder) / f"{chosen.set}-{seed}.toml"
            scene.write_text(text)
            requests.append(RehearsalRequest(scene=str(scene), seed=seed, sensors="real", **chosen.frames, **fields))
        for request, result in zip(requests, pool.map(_run, requests), strict=True):
            for name, values in measured.items():
                values.append(result["truth"][name])
            runs.add(good(result), _line(chosen.set, request, result))
    runs.share(f"{chosen.set}: reached by the truth", least)
    for name, (what, unit) in SHOWN.items():
        report.value(what, measured[name], unit)
    report.value("longest stand", [max(measured["stood_s"])], "s")


def _line(name: str, request: RehearsalRequest, result: dict[str, Any]) -> str:
    truth = result["truth"]
    return (
        f"{name} seed {request.seed:2d}  {result['outcome']} {result['reason']}  stood {truth['stood_s']:.2f} s, with"
        f" it {truth['near_share']:.0%} (its own measure {result['measures'].get('near_share', 0.0):.0%}), mean gap"
        f" {truth['mean_gap_m']:.2f} m, lost {truth['lost_s']:.1f} s, touched {truth['contacts']}"
    )
