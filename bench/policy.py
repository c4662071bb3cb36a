"""Measures the way from captures to a policy: fetches recorded, exported, imitated in NumPy, and the policy let loose.

`python -m bench policy` rehearses fetches of a red can that stands 0.9 to 1.5 m ahead, at most 20 degrees aside,
exports them as a LeRobotDataset, trains a small network from that dataset alone, and has the task `policy` run it in
scenes of the same kind that it never saw. The truth judges: the can is held and lifted, nothing else was touched.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from apps.captures.export import lerobot
from bench.policy_data import Episode, episodes_of, layout_of
from bench.policy_learned import Look, Network
from bench.policy_scenes import LABEL, Case, Judged, all_rehearsed, judged
from bench.policy_training import begun, pairs_of, train, write
from bench.report import Report
from bench.trials import Runs, add_frames, add_jobs, number_of, sized
from cocoro.errors import CocoroError
from cocoro.features import PolicyFeatures
from cocoro.robot import Robot

FRESH = 1_000_000
"""First seed of the scenes that the policy is tried in."""
FOR_S = 11.0
"""How long it moves the robot."""
NAME = "learned"
CHUNK, EVERY = 8, 2
"""Rows that it proposes at once, and from one observation to the next."""
HIDDEN = (128, 128)
HELD_OUT = 8
"""One of so many episodes is not learned from; it tells the error."""
TRAINING_S = 600.0


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--fetches", type=number_of, help="to learn from (40)")
    parser.add_argument("--scenes", type=number_of, help="fresh ones that the policy is tried in (10)")
    parser.add_argument("--least", type=number_of, help="of them in which it must lift the can (7 of 10)")
    parser.add_argument("--steps", type=number_of, help="of training (10000)")
    parser.add_argument("--sensors", choices=("ideal", "real"), default="ideal")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="new folder for captures, dataset and policy")
    add_frames(parser, "160x120@10")
    add_jobs(parser)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    with ExitStack() as stack:
        place = chosen.keep.absolute() if chosen.keep else Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name in ("captures", "tries", "scenes", "policy"):
            try:
                (place / name).mkdir(parents=True)
            except FileExistsError as error:
                raise CocoroError(f"--keep {place}: it has {name} already") from error
        _record(chosen, place, report)
        made = lerobot.export([place / "captures"], place / "dataset")
        report.share("fetches that became an episode", made.episodes, sized(chosen, chosen.fetches, 40, 3))
        source = _learn(chosen, place, report)
        _try(chosen, place, source, report)


def _record(chosen: argparse.Namespace, place: Path, report: Report) -> None:
    fetches = range(sized(chosen, chosen.fetches, 40, 3))
    cases = [
        Case(place / "scenes", seed, chosen.frames, chosen.sensors, place / "captures" / f"fetch-{seed:04}.mcap")
        for seed in fetches
    ]
    began_s = time.perf_counter()
    for case, result in all_rehearsed(cases, chosen.jobs):
        report.say(f"{case.record.name}: {result['outcome']} {result['reason']} {result['sim_s']:.1f} s")
    report.value("recording, wall time", [time.perf_counter() - began_s], "s")
    robot = Robot.load()
    _compare("the planner's fetches", [judged(robot, case) for case in cases], report)


def _compare(whose: str, runs: list[Judged], report: Report) -> None:
    """Figures of the good runs of planner or policy."""
    times = [run.lifted_s for run in runs if run.good and run.lifted_s is not None]
    pushed = [1000 * run.verdict.target_moved_m for run in runs if run.good]
    if times and pushed:
        report.value(f"time until the can was lifted, {whose}", times, "s")
        report.value(f"can pushed before the grasp, {whose}", pushed, "mm")


def _learn(chosen: argparse.Namespace, place: Path, report: Report) -> str:
    """Train a policy from the dataset, and write it. Returns what a task names it by."""
    began_s, cpu_s = time.perf_counter(), time.process_time()
    layout = layout_of(place / "dataset")
    look = Look(Robot.load(), layout.width, layout.height)
    episodes = episodes_of(place / "dataset", look, f"fetch {LABEL}")
    held, learn = episodes[::HELD_OUT], [one for number, one in enumerate(episodes) if number % HELD_OUT]
    if not learn:
        raise CocoroError(f"{len(episodes)} fetches succeeded: too few to learn from")
    draw, pairs = np.random.default_rng(0), pairs_of(learn, CHUNK)
    network = begun(pairs, HIDDEN, draw)
    train(network, pairs, sized(chosen, chosen.steps, 10_000, 300), look.noise, draw)
    features = PolicyFeatures(
        state=layout.names, action=layout.names, rate_hz=layout.rate_hz, chunk=CHUNK, every=EVERY,
        width=layout.width, height=layout.height, robot=layout.robot,
    )  # fmt: skip
    source = write(place / "policy", NAME, network, features)
    report.value("rows learned from", [len(pairs.inputs)], "")
    report.value("training, wall time", [time.perf_counter() - began_s], "s", at_most=TRAINING_S)
    report.value("training, processor time", [time.process_time() - cpu_s], "s")
    report.value("error of a joint's goal, episodes held out", [_joints_off_rad(network, held)], "rad")
    return source


def _joints_off_rad(network: Network, episodes: list[Episode]) -> float:
    """Root mean square over all joints and rows of the chunks."""
    pairs, joints = pairs_of(episodes, CHUNK), len(Robot.load().joints)
    off = (network(pairs.inputs) - pairs.chunks).reshape(len(pairs.inputs), CHUNK, -1)[..., :joints]
    return float(np.sqrt(np.mean(off**2)))


def _try(chosen: argparse.Namespace, place: Path, source: str, report: Report) -> None:
    count = sized(chosen, chosen.scenes, 10, 1)
    least = sized(chosen, chosen.least, max(1, round(0.7 * count)), 0)
    cases = [
        Case(place / "scenes", seed, chosen.frames, chosen.sensors, place / "tries" / f"{seed}.mcap", source, FOR_S)
        for seed in range(FRESH, FRESH + count)
    ]
    runs, robot, found = Runs(report), Robot.load(), []
    for case, result in all_rehearsed(cases, chosen.jobs):
        found.append(judged(robot, case))
        truth = found[-1].verdict
        touched = ", ".join(truth.collisions) or "nothing else"
        line = (
            f"scene {case.seed}: {result['outcome']} {result['reason']} lifted {truth.lifted_m:.3f} m, held "
            f"{truth.held}, pushed {truth.target_moved_m:.3f} m before, touched {touched}"
        )
        runs.add(found[-1].good, line)
    runs.share("fresh scenes in which the policy lifted the can and touched nothing else", least)
    _compare("the policy", found, report)
