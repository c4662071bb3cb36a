"""Measures how often tasks succeed by the true state: `python -m bench rehearsals paper --seeds 0:10`.

Rehearsals run in parallel processes; the share of those that met the set's conditions must be all, or `--least`. Only
the wall time depends on the machine's load. `python -m bench rehearsals random --latency perception=0.2 --seeds 0:100`
has perception take 0.2 s longer for each frame. `paper-scaled` and `random-scaled` are for other robots, one can for
each seed: `python -m bench rehearsals paper-scaled --robot lekiwi --frames 320x240@15 --seeds 0:30`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from apps.rehearsal.request import RehearsalRequest
from bench.report import Report
from bench.trials import Runs, add_frames, add_jobs, add_latency, number_of, sized, span
from services.executive.tasks import FetchTask, FollowTask
from sim.random_scene import random_scene

Result = dict[str, Any]
PAPER = ("red_can", "green_can", "blue_can")


def _fetched(result: Result) -> bool:
    truth = result["truth"]
    return bool(result["outcome"] == "done" and truth["held"] and not truth["knocked_over"])


def _no_contact(result: Result) -> bool:
    return _fetched(result) and not result["truth"]["collisions"]


def _followed(result: Result) -> bool:
    truth = result["truth"]
    return bool(result["outcome"] == "done" and truth["lost_s"] <= 1.0 and truth["contacts"] == 0)


def _brought(result: Result) -> bool:
    truth = result["truth"]
    return bool(result["outcome"] == "done" and truth["target_standing"] and truth["target_from_start_m"] <= 0.15)


def _not_found(result: Result) -> bool:
    return bool(result["reason"].startswith("not_found") and result["sim_s"] < 90.0)


def _paper(seed: int) -> Iterator[dict[str, Any]]:
    for label in PAPER:
        yield {"task": FetchTask(label=label)}


def _paper_scaled(seed: int) -> Iterator[dict[str, Any]]:
    yield {"task": FetchTask(label=PAPER[seed % 3]), "scene": "paper-scaled"}


def _random(seed: int) -> Iterator[dict[str, Any]]:
    yield {"task": FetchTask(label=random_scene(seed).objects[0].label), "scene": "random"}


def _random_scaled(seed: int) -> Iterator[dict[str, Any]]:
    yield {"task": FetchTask(label=random_scene(seed).objects[0].label), "scene": "random-scaled"}


def _follow(seed: int) -> Iterator[dict[str, Any]]:
    yield {"task": FollowTask(label="blue_ball", for_s=33.0), "scene": "follow"}
    yield {"task": FollowTask(label="blue_ball", for_s=24.0), "scene": "follow-fast"}


def _bring(seed: int) -> Iterator[dict[str, Any]]:
    yield {"task": FetchTask(label=PAPER[seed % 3], bring=True)}


def _absent(seed: int) -> Iterator[dict[str, Any]]:
    yield {"task": FetchTask(label="yellow_ball")}


SETS: dict[str, tuple[Callable[[int], Iterator[dict[str, Any]]], Callable[[Result], bool]]] = {
    "paper": (_paper, _fetched),
    "random": (_random, _no_contact),
    "paper-scaled": (_paper_scaled, _fetched),
    "random-scaled": (_random_scaled, _fetched),
    "follow": (_follow, _followed),
    "bring": (_bring, _brought),
    "absent": (_absent, _not_found),
}


def _run(request: RehearsalRequest) -> Result:
    from apps.rehearsal.rehearse import rehearse
    from cocoro.errors import CocoroError

    try:
        return rehearse(request)
    except CocoroError as error:
        return {"outcome": "error", "reason": str(error), "sim_s": 0.0, "wall_s": 0.0, "truth": {}}


def _line(request: RehearsalRequest, result: Result) -> str:
    truth = {
        name: round(value, 3) if isinstance(value, float) else value
        for name, value in result["truth"].items()
        if value not in ([], None)
    }
    what = f"{request.task.name} {request.task.target} {request.scene} seed {request.seed}"
    return f"{what:44s} {result['outcome']} {result['reason']} {result['sim_s']:.1f} s {json.dumps(truth)}"


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("set", choices=SETS, nargs="?", default="paper")
    parser.add_argument("--seeds", type=span, metavar="FROM:TO", help="of each task (0:10)")
    parser.add_argument("--least", type=number_of, help="rehearsals that must be good (all)")
    parser.add_argument("--sensors", choices=("ideal", "real"), default="real")
    parser.add_argument("--robot", help="a robot that the project ships, or the file of its description")
    add_frames(parser, "640x480@30")
    parser.add_argument("--lockstep", action="store_true", help="perception and planning as one serial cycle")
    add_latency(parser)
    add_jobs(parser)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    make, good = SETS[chosen.set]
    latency = {name: seconds for each in chosen.latency for name, seconds in each.items()}
    common = {"sensors": chosen.sensors, "lockstep": chosen.lockstep, "latency": latency, **chosen.frames}
    if chosen.robot is not None:
        common["description"] = chosen.robot
    seeds = sized(chosen, chosen.seeds, range(10), range(1))
    requests = [RehearsalRequest(**common, **what, seed=seed) for seed in seeds for what in make(seed)]
    runs, times, rates = Runs(report), [], []
    with ProcessPoolExecutor(chosen.jobs, max_tasks_per_child=1) as pool:
        for request, result in zip(requests, pool.map(_run, requests), strict=True):
            times.append(result["sim_s"])
            rates.append(result["sim_s"] / max(result["wall_s"], 1e-9))
            runs.add(bool(result["truth"]) and good(result), _line(request, result))
    runs.share(f"{chosen.set}: good by the truth", chosen.least)
    report.value("time, simulated", times, "s")
    report.value("longest time, simulated", [max(times)], "s")
    report.value(f"speed as a multiple of real time, {chosen.jobs} at once", rates, "times")
