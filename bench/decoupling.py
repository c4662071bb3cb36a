"""Measures what decoupling is worth: the mesh and lock-step, the slower perception computes.

Fetches and pursuits in virtual time with real sensors (frames of 320 x 240 at 15 Hz), and fetches over zenoh processes
real time (640 x 480 at 30 Hz). Lock-step is the paper's serial cycle: sense, perceive, plan, act, one after another. It
is as strong as that allows: the same planner with gains that fit the cycle, the newest odometry and joint states at the
time of planning (the paper's cycle polled them at its begin), and commands that never expire. Perception's time is
waited for, not computed, so that it takes no processor time from the rest.
"""

from __future__ import annotations

import argparse
import asyncio
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from math import sqrt
from statistics import median
from typing import Any, Literal, NamedTuple

import numpy as np

from bench.lockstep_live import LiveRun, live_fetch
from bench.report import Chart, Report, Series, percentile, spread
from services.planning.config import FollowConfig
from sim.judge import SETTLE_S
from sim.random_scene import find_scene
from sim.stage import Mover

TIMES_S = (0.005, 0.05, 0.1, 0.2, 0.5, 1.0)
PURSUIT_TIMES_S = (0.005, 0.1, 0.5, 1.0)
LIVE_TIMES_S = (0.1, 0.5)
SHORT_TIMES_S = (0.1, 0.5)
DISTANCE_M = FollowConfig().distance_m
IDEAL = "a robot without limits"
PERCEPTION_AXIS = "time of perception for a frame, s"
FOR_S = 20.0
"""Time of a pursuit."""
Way = Literal["mesh", "lock-step"]
WAYS: tuple[Way, ...] = ("mesh", "lock-step")


class Case(NamedTuple):
    """A rehearsal: what is done, which way, perception's time, s, and the seed."""

    task: Literal["fetch", "follow"]
    way: Way
    time_s: float
    seed: int


def rehearsed(case: Case) -> dict[str, Any]:
    """The result of a case's rehearsal."""
    from apps.rehearsal.rehearse import rehearse
    from apps.rehearsal.request import RehearsalRequest
    from services.executive.tasks import FetchTask, FollowTask

    fetch = case.task == "fetch"
    request = RehearsalRequest(
        task=FetchTask(label="green_can") if fetch else FollowTask(label="blue_ball", for_s=FOR_S),
        scene="paper" if fetch else "follow",
        sensors="real",
        seed=case.seed,
        width=320,
        height=240,
        frame_rate_hz=15.0,
        latency={"perception": case.time_s},
        lockstep=case.way == "lock-step",
    )
    return rehearse(request)


def good(case: Case, result: dict[str, Any]) -> bool:
    """Whether the task was done, by the truth: held and nothing knocked over, or followed without a touch."""
    truth = result["truth"]
    if result["outcome"] != "done":
        return False
    if case.task == "fetch":
        return bool(truth["held"] and not truth["knocked_over"])
    return bool(truth["contacts"] == 0 and truth["lost_s"] <= 1.0)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=3, help="of each case (3)")
    parser.add_argument("--no-live", action="store_true", help="without the processes in real time")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    seeds = 1 if chosen.short else chosen.seeds
    fetch_times = SHORT_TIMES_S if chosen.short else TIMES_S
    follow_times = SHORT_TIMES_S[1:] if chosen.short else PURSUIT_TIMES_S
    cases = [Case("fetch", way, time_s, seed) for time_s in fetch_times for seed in range(seeds) for way in WAYS]
    cases += [Case("follow", way, time_s, seed) for time_s in follow_times for seed in range(seeds) for way in WAYS]
    results: dict[Case, dict[str, Any]] = {}
    with ProcessPoolExecutor() as pool:
        for case, result in zip(cases, pool.map(rehearsed, cases), strict=True):
            results[case] = result
            report.say(f"{case.task} {case.way} {case.time_s:g} s, seed {case.seed}: {result['outcome']}")
    _fetches(report, fetch_times, seeds, results)
    _pursuits(report, follow_times, seeds, results)
    if not chosen.short and not chosen.no_live:
        _live(report)


def _pairs(
    task: Literal["fetch", "follow"], time_s: float, seeds: int, results: dict[Case, dict[str, Any]]
) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """The results of both ways, for the seeds at which both were good."""
    pairs = []
    for seed in range(seeds):
        ours, theirs = (Case(task, way, time_s, seed) for way in WAYS)
        if good(ours, results[ours]) and good(theirs, results[theirs]):
            pairs.append((results[ours], results[theirs]))
    return pairs


def _shares(
    report: Report, task: Literal["fetch", "follow"], done: str, times_s: Sequence[float], seeds: int,
    results: dict[Case, dict[str, Any]],
) -> None:  # fmt: skip
    for way in WAYS:
        cases = [Case(task, way, time_s, seed) for time_s in times_s for seed in range(seeds)]
        count = sum(good(case, results[case]) for case in cases)
        report.share(f"{done}, {way}, all times", count, len(cases), at_least=len(cases) if way == "mesh" else None)


FETCH_BOUNDS = {0.1: 0.7, 0.5: 0.5}


def _fetches(report: Report, times_s: Sequence[float], seeds: int, results: dict[Case, dict[str, Any]]) -> None:
    lines: dict[Way, list[tuple[float, float, float, float]]] = {way: [] for way in WAYS}
    for time_s in times_s:
        for way in WAYS:
            taken = [
                results[case]["sim_s"]
                for seed in range(seeds)
                if good(case := Case("fetch", way, time_s, seed), results[case])
            ]
            if taken:
                report.value(f"fetch, perception {time_s:g} s, {way}", taken, "s")
                middle, low, high, _ = spread("fetch", taken)
                lines[way].append((time_s, middle, low, high))
        pairs = _pairs("fetch", time_s, seeds, results)
        if pairs:
            report.ratio(
                f"fetch, perception {time_s:g} s: mesh / lock-step",
                [ours["sim_s"] for ours, _ in pairs],
                [theirs["sim_s"] for _, theirs in pairs],
                at_most=FETCH_BOUNDS.get(time_s),
                better="less",
            )
    _shares(report, "fetch", "fetched", times_s, seeds, results)
    report.charts.append(
        Chart(
            "fetch", "A fetch, the slower perception computes", PERCEPTION_AXIS, "time of a fetch, s",
            [Series(way, points) for way, points in lines.items() if points], log_x=True,
        )
    )  # fmt: skip


def ideal_off_m(time_s: float, frame_rate_hz: float = 15.0) -> float:
    """The root mean square of how far a robot without limits would be off its distance in the same pursuit, m: it is at
    once wherever it wants to be, sees without noise, and expects the ball to go on as it went between the two newest
    sightings, which are as late as perception's time makes them. With this sight no robot knows of a corner sooner."""
    ball = find_scene("follow", 0, "blue_ball").object("blue_ball")
    waypoints = [ball.position_m, *ball.path_m]
    mover = Mover([(place[0], place[1], 0.0) for place in waypoints], ball.speed_mps, loop=ball.path_loop)
    period_s, step_s, robot_m = 1.0 / frame_rate_hz, 0.005, np.zeros(2)
    seen, looking, off_m2 = list[float](), deque[tuple[float, float]](), list[float]()
    for tick in range(round((FOR_S + time_s) / step_s)):
        now_s = tick * step_s
        if looking and now_s >= looking[0][1]:
            seen.append(looking.popleft()[0])
        frame_s = now_s // period_s * period_s
        if not looking and (not seen or frame_s > seen[-1]):
            looking.append((frame_s, now_s + time_s))
        if len(seen) < 2:
            continue
        before, last = (mover.at(stamp_s)[:2] for stamp_s in seen[-2:])
        expected = last + (last - before) * (now_s - seen[-1]) / (seen[-1] - seen[-2])
        way = expected - robot_m
        robot_m = robot_m + way * (1.0 - DISTANCE_M / float(np.linalg.norm(way)))
        if now_s > SETTLE_S:
            off_m2.append((float(np.linalg.norm(mover.at(now_s)[:2] - robot_m)) - DISTANCE_M) ** 2)
    return sqrt(float(np.mean(off_m2)))


def _pursuits(report: Report, times_s: Sequence[float], seeds: int, results: dict[Case, dict[str, Any]]) -> None:
    lines: dict[str, list[tuple[float, float, float, float]]] = {way: [] for way in (*WAYS, IDEAL)}
    for time_s in times_s:
        ideal_m = ideal_off_m(time_s)
        lines[IDEAL].append((time_s, ideal_m, ideal_m, ideal_m))
        report.value(f"off its distance, perception {time_s:g} s, {IDEAL}", [ideal_m], "m")
        pairs = _pairs("follow", time_s, seeds, results)
        for number, way in enumerate(WAYS):
            off = [pair[number]["truth"]["off_m"] for pair in pairs]
            if off:
                report.value(f"off its distance, perception {time_s:g} s, {way}", off, "m")
                middle, low, high, _ = spread("off", off)
                lines[way].append((time_s, middle, low, high))
        if pairs:
            report.ratio(
                f"off its distance, perception {time_s:g} s: mesh / lock-step",
                [ours["truth"]["off_m"] for ours, _ in pairs],
                [theirs["truth"]["off_m"] for _, theirs in pairs],
                at_most=1 / 3 if time_s == 0.5 else None,
                better="less",
            )
            lockstep_m = median(theirs["truth"]["off_m"] for _, theirs in pairs)
            if ideal_m > lockstep_m / 3:
                report.notes.append(
                    f"With perception at {time_s:g} s no robot with this sight tracks with a third of lock-step's "
                    f"error: a third is {lockstep_m / 3:.3f} m, and one without limits is off by {ideal_m:.3f} m, "
                    "since it cannot know of a corner before it is seen. Lock-step has the newest odometry and "
                    "expects the ball to go on, as the mesh does, and so decoupling gains nothing here."
                )
        for way in WAYS:
            command = [
                results[case]["commands"]
                for seed in range(seeds)
                if results[case := Case("follow", way, time_s, seed)]["commands"]
            ]
            report.value(
                f"period of wheel commands (p99), perception {time_s:g} s, {way}",
                [periods["p99_ms"] for periods in command],
                "ms",
                at_most=25.0 if way == "mesh" else None,
            )
    _shares(report, "follow", "followed", times_s, seeds, results)
    report.charts.append(
        Chart(
            "pursuit", "A pursuit at 0.25 m/s, the slower perception computes", PERCEPTION_AXIS,
            "off its distance (rms, after 5 s), m", [Series(way, points) for way, points in lines.items() if points],
            log_x=True,
        )
    )  # fmt: skip


def _live(report: Report) -> None:
    for time_s in LIVE_TIMES_S:
        runs: dict[Way, LiveRun] = {}
        for way in WAYS:
            runs[way] = asyncio.run(live_fetch(time_s, lockstep=way == "lock-step"))
            run = runs[way]
            report.say(f"live, {way}, perception {time_s:g} s: {run.outcome}")
            periods = run.periods_ms
            name = f"processes in real time, perception {time_s:g} s, {way}"
            if periods:
                report.value(f"{name}: rate of wheel commands", [1e3 * len(periods) / sum(periods)], "Hz")
                bound = 25.0 if way == "mesh" and time_s == 0.5 else None
                report.value(f"{name}: period (p99)", [percentile(periods, 99)], "ms", at_most=bound)
            report.share(f"{name}: held by the truth", int(run.held), 1, at_least=1 if way == "mesh" else None)
            if run.held:
                report.value(f"{name}: fetch", [run.seconds], "s")
        if all(run.held for run in runs.values()):
            report.ratio(
                f"processes in real time, perception {time_s:g} s: fetch, mesh / lock-step",
                [runs["mesh"].seconds],
                [runs["lock-step"].seconds],
                better="less",
            )
