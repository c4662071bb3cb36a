"""Measures the search behind walls: `python -m bench rooms --seeds 0:40`.

In each random room the robot fetches an object that it cannot see from the start, and then looks for one that is not
there. By the truth: the object is held within 90 s and nothing was touched; the search ends with `not_found`, and the
camera has seen every cell of the floor within the search's radius that a pose of the robot can show. What it said of
that is counted, too. Rehearsals run in parallel processes; only the wall time depends on the machine's load.
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from bench.report import Report, Table
from bench.trials import Runs, add_frames, add_jobs, sized, span
from cocoro.errors import CocoroError
from services.executive.tasks import FetchTask
from services.planning.config import SearchConfig
from sim.random_scene import EMPTY, ROOMS, room_scene

Result = dict[str, Any]
WITHIN_S = 90.0
REACHED = {ROOMS: f"held within {WITHIN_S:.0f} s, nothing touched", EMPTY: "not_found, all floor seen"}
"""By scene, what is judged."""


def _run(request: RehearsalRequest) -> Result:
    try:
        return rehearse(request)
    except CocoroError as error:
        return {"outcome": "error", "reason": str(error), "sim_s": 0.0, "truth": {}, "seen_floor": {}}


def _held(result: Result) -> bool:
    truth = result["truth"]
    untouched = not truth.get("collisions", True) and not truth.get("knocked_over", True)
    return bool(result["outcome"] == "done" and truth["held"] and untouched and result["sim_s"] <= WITHIN_S)


def _searched(result: Result) -> bool:
    all_seen = result["seen_floor"].get("missed") == 0
    return bool(result["reason"].startswith("not_found") and all_seen and not result["truth"]["collisions"])


def _said(result: Result) -> str:
    """Whether it said that it saw every place where the object could stand, and whether that was true."""
    if not result["reason"].startswith("not_found: every place"):
        return "a part"
    return "all, wrongly" if result["seen_floor"]["hiding"] else "all, rightly"


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=span, metavar="FROM:TO", help="of the rooms (0:40)")
    parser.add_argument("--only", choices=(ROOMS, EMPTY))
    add_frames(parser, "320x240@15")
    parser.add_argument("--sensors", choices=("ideal", "real"), default="real")
    add_jobs(parser)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    requests = [
        RehearsalRequest(
            task=FetchTask(label=room_scene(seed).objects[0].label),
            scene=scene,
            seed=seed,
            sensors=chosen.sensors,
            seen_within_m=SearchConfig().radius_m,
            **chosen.frames,
        )
        for seed in sized(chosen, chosen.seeds, range(40), range(1))
        for scene in (ROOMS, EMPTY)
        if chosen.only in (None, scene)
    ]
    runs = {scene: Runs(report) for scene in dict.fromkeys(request.scene for request in requests)}
    times: dict[str, list[float]] = {scene: [] for scene in runs}
    said: Counter[str] = Counter()
    unseeable = 0
    with ProcessPoolExecutor(chosen.jobs, max_tasks_per_child=1) as pool:
        for request, result in zip(requests, pool.map(_run, requests), strict=True):
            reached = (_held if request.scene == ROOMS else _searched)(result)
            times[request.scene].append(result["sim_s"])
            if request.scene == EMPTY:
                unseeable += result["seen_floor"].get("unseeable", 0)
                said[_said(result)] += 1
            runs[request.scene].add(reached, _line(request, result))
    for scene, made in runs.items():
        made.share(f"{scene}: {REACHED[scene]}")
        report.value(f"{scene}: time", times[scene], "s")
        report.value(f"{scene}: longest time", [max(times[scene])], "s")
    if said:
        rows = [[f"said that it saw {what}", str(count)] for what, count in said.items()]
        rows.append(["cells that no pose can show", str(unseeable)])
        report.tables.append(Table("Searches for an object that is not there", ["what", "count"], rows))


def _line(request: RehearsalRequest, result: Result) -> str:
    floor, truth = result["seen_floor"], result["truth"]
    return (
        f"{request.scene:11s} seed {request.seed:2d} {request.task.target:11s}"
        f" {result['sim_s']:6.1f} s {result['outcome']} {result['reason']}"
        f" | touched {[*truth.get('collisions', ()), *truth.get('knocked_over', ())]}"
        f" | cells {floor.get('cells')} missed {floor.get('missed')} hiding {floor.get('hiding')}"
        f" {floor.get('missed_at_m') or ''}"
    )
