"""Measures how often tasks succeed by the true state: `python -m bench.rehearsals paper --sensors real --seeds 0:10`.

Runs rehearsals in parallel processes and prints a line for each, then the share that met the set's conditions. Exit
code 1 when one did not. Only the wall time depends on the machine's load.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from apps.rehearsal.request import RehearsalRequest
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


def _random(seed: int) -> Iterator[dict[str, Any]]:
    yield {"task": FetchTask(label=random_scene(seed).objects[0].label), "scene": "random"}


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


def _line(request: RehearsalRequest, result: Result, good: bool) -> str:
    truth = {
        name: round(value, 3) if isinstance(value, float) else value
        for name, value in result["truth"].items()
        if value not in ([], None)
    }
    mark = "ok " if good else "BAD"
    what = f"{request.task.name} {request.task.target} {request.scene} seed {request.seed}"
    return f"{mark} {what:44s} {result['outcome']} {result['reason']} {result['sim_s']:.1f} s {json.dumps(truth)}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", choices=SETS)
    parser.add_argument("--seeds", default="0:10", help="from:to")
    parser.add_argument("--sensors", choices=("ideal", "real"), default="real")
    parser.add_argument("--frames", default="640x480@30")
    parser.add_argument("--lockstep", action="store_true")
    parser.add_argument("--latency", type=float, default=0.0, help="of perception, seconds")
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args()
    size, _, rate = asked.frames.partition("@")
    width, height = (int(number) for number in size.split("x"))
    make, good = SETS[asked.set]
    first, last = (int(number) for number in asked.seeds.split(":"))
    common: dict[str, Any] = {
        "sensors": asked.sensors,
        "width": width,
        "height": height,
        "frame_rate_hz": float(rate or 30.0),
        "lockstep": asked.lockstep,
        "latency": {"perception": asked.latency} if asked.latency else {},
    }
    requests = [RehearsalRequest(**common, **what, seed=seed) for seed in range(first, last) for what in make(seed)]
    times: list[float] = []
    rates: list[float] = []
    count = 0
    with ProcessPoolExecutor(asked.jobs, max_tasks_per_child=1) as pool:
        for request, result in zip(requests, pool.map(_run, requests), strict=True):
            reached = good(result) if result["truth"] else False
            count += reached
            times.append(result["sim_s"])
            rates.append(result["sim_s"] / max(result["wall_s"], 1e-9))
            print(_line(request, result, reached), flush=True)
    print(
        f"{count} of {len(requests)}; simulated {statistics.median(times):.1f} s median, {max(times):.1f} s longest;"
        f" {statistics.median(rates):.2f} times real time with {asked.jobs} at once"
    )
    return 0 if count == len(requests) else 1


if __name__ == "__main__":
    sys.exit(main())
