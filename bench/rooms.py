"""Measures the search behind walls: `python -m bench.rooms --seeds 0:40`.

In each random room the robot fetches an object that it cannot see from the start, and then looks for one that is not
there. By the truth: the object is held within 90 s and nothing was touched; the search ends with `not_found`, and the
camera has seen every cell of the floor within the search's radius that a pose of the robot can show. What it said of
that is counted, too. Rehearsals run in parallel processes; only the wall time depends on the machine's load. Exit code
1 when one room did not meet it.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.errors import CocoroError
from services.executive.tasks import FetchTask
from services.planning.config import SearchConfig
from sim.random_scene import EMPTY, ROOMS, room_scene

Result = dict[str, Any]
WITHIN_S = 90.0


def _run(request: RehearsalRequest) -> Result:
    try:
        return rehearse(request)
    except CocoroError as error:
        return {"outcome": "error", "reason": str(error), "sim_s": 0.0, "truth": {}, "seen_floor": {}}


def _held(result: Result) -> bool:
    truth = result["truth"]
    untouched = not truth.get("collisions", True) and not truth.get("knocked_over", True)
    return result["outcome"] == "done" and truth["held"] and untouched and result["sim_s"] <= WITHIN_S


def _searched(result: Result) -> bool:
    all_seen = result["seen_floor"].get("missed") == 0
    return result["reason"].startswith("not_found") and all_seen and not result["truth"]["collisions"]


def _said(result: Result) -> str:
    """Whether it said that it saw every place where the object could stand, and whether that was true."""
    if not result["reason"].startswith("not_found: every place"):
        return "a part"
    return "all, wrongly" if result["seen_floor"]["hiding"] else "all, rightly"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="0:40", help="from:to")
    parser.add_argument("--only", choices=(ROOMS, EMPTY))
    parser.add_argument("--frames", default="320x240@15")
    parser.add_argument("--sensors", choices=("ideal", "real"), default="real")
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args()
    size, _, rate = asked.frames.partition("@")
    width, height = (int(number) for number in size.split("x"))
    first, last = (int(number) for number in asked.seeds.split(":"))
    requests = [
        RehearsalRequest(
            task=FetchTask(label=room_scene(seed).objects[0].label),
            scene=scene,
            seed=seed,
            sensors=asked.sensors,
            width=width,
            height=height,
            frame_rate_hz=float(rate or 30.0),
            seen_within_m=SearchConfig().radius_m,
        )
        for seed in range(first, last)
        for scene in (ROOMS, EMPTY)
        if asked.only in (None, scene)
    ]
    good = {ROOMS: 0, EMPTY: 0}
    count = dict(good)
    unseeable = 0
    said: Counter[str] = Counter()
    with ProcessPoolExecutor(asked.jobs, max_tasks_per_child=1) as pool:
        for request, result in zip(requests, pool.map(_run, requests), strict=True):
            reached = (_held if request.scene == ROOMS else _searched)(result)
            good[request.scene] += reached
            count[request.scene] += 1
            floor, truth = result["seen_floor"], result["truth"]
            if request.scene == EMPTY:
                unseeable += floor.get("unseeable", 0)
                said[_said(result)] += 1
            print(
                f"{'ok ' if reached else 'BAD'} {request.scene:11s} seed {request.seed:2d} {request.task.target:11s}"
                f" {result['sim_s']:6.1f} s {result['outcome']} {result['reason']}"
                f" | touched {[*truth.get('collisions', ()), *truth.get('knocked_over', ())]}"
                f" | cells {floor.get('cells')} missed {floor.get('missed')} hiding {floor.get('hiding')}"
                f" {floor.get('missed_at_m') or ''}",
                flush=True,
            )
    for scene, text in (
        (ROOMS, f"held within {WITHIN_S:.0f} s, nothing touched"),
        (EMPTY, "not_found, all floor seen"),
    ):
        if count[scene]:
            print(f"{scene}: {good[scene]} of {count[scene]} {text}")
    if count[EMPTY]:
        print(f"cells that no pose can show: {unseeable}")
        print(f"said: {dict(said)}; slivers: cells were missed, but no two by two, which could hide an object")
    return 0 if good == count else 1


if __name__ == "__main__":
    sys.exit(main())
