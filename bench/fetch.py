"""Measures each phase of a fetch beside what the robot's body allows.

Fetches of the paper's scene in virtual time, with real sensors. The limits are computed from the robot's description:
base and servos at their top speed and acceleration, the latency of the sensors, and nothing else. No program reaches
them: a servo at its top speed has no torque left, and what is seen must be computed, sent and confirmed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from math import atan2, sqrt
from typing import Any, NamedTuple

from apps.rehearsal.request import RehearsalRequest
from bench.rehearsals import PAPER
from bench.report import Report, Table, number, spread
from cocoro.robot import Robot
from cocoro.tasks import Limits
from services.executive.tasks import FetchTask
from services.planning.behaviours.base import Actuators
from services.planning.behaviours.driving import grasp_aim
from services.planning.config import PlanningConfig
from services.planning.navigation import offset_to
from services.planning.reach import HandPose
from sim.random_scene import find_scene
from sim.service import FRAME_LATENCY_S

PHASES = ("search", "approach", "reach", "grasp", "lift", "hold")
MOST_S = 8.5
PICTURES = 2
"""A target counts when two pictures have shown it."""
WAITS = {
    "search": "the head's ramps; two pictures at each aim; nobody knows where the target is",
    "approach": "0.48 of 0.5 m/s and 1.0 of 2.5 m/s2, so that a fault at any time leaves it standing within 0.3 s and"
    " nothing tips; floor that the arm swings over must have been seen; the arm's joints at 2.4 of 6 rad/s",
    "reach": "0.35 m/s along the hand's own axis, while the base comes to rest",
    "grasp": "claws at 1.2 of 6 rad/s (twice as fast, 8 of 9 grips slipped), then 0.25 s in which the grip must hold",
    "lift": "0.25 m/s, straight up before inwards, so that the load does not leave the claws when it stops",
    "hold": "the task's own: what is lifted must stay held",
}


class FetchCase(NamedTuple):
    label: str
    seed: int
    width: int
    height: int
    rate_hz: float


def ramp_s(way: float, speed: float, acceleration: float) -> float:
    """Least time for a way from rest to rest, with a top speed and an acceleration, all in the same unit of way."""
    if way * acceleration <= speed**2:
        return 2 * sqrt(way / acceleration)
    return way / speed + speed / acceleration


class FetchLimits:
    """The least time of each phase, by the description of the robot."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._config = PlanningConfig()
        self._actuators = Actuators(robot, self._config)

    def of(self, place_m: tuple[float, float, float]) -> dict[str, float]:
        """Seconds by phase for a target at (x, y, z), body frame at the begin, m."""
        robot, config, reachability = self._robot, self._config, self._actuators.reachability
        base, kinect = robot.base, robot.eye
        aim_m = grasp_aim(self._actuators)
        offset = offset_to(place_m[:2], aim_m)
        grasp = reachability.grasp((*aim_m, place_m[2]))
        lifted = HandPose(
            config.arm.carry_radius_m,
            grasp.around.azimuth_rad,
            grasp.around.height_m + config.arm.carry_rise_m,
            config.arm.pitch_rad,
        )
        roll = robot.arm.roll
        parked = robot.poses["park"] | {roll: 0.0}
        out = parked | robot.poses["unfolded"] | {roll: robot.claw.level_roll_rad}
        behind, around, up = (self._joints(pose) for pose in (grasp.behind, grasp.around, lifted))
        # The wheel on the outer side drives the way and its share of the turn.
        outer_m = abs(offset.ahead_m) + abs(offset.heading_rad) * robot.drive.lever_m
        drive_s = ramp_s(outer_m, base.max_wheel_speed_mps, base.wheel_acceleration_mps2)
        unfold_s = self._servos_s(parked, out) + self._servos_s(out, behind)
        beside_rad = max(abs(atan2(place_m[1], place_m[0])) - kinect.horizontal_fov_rad / 2, 0.0)
        claws = dict.fromkeys(robot.jaws, config.hand.open_rad)
        return {
            "search": beside_rad / robot.joints[robot.head_joints[0]].max_speed_radps
            + PICTURES / kinect.rate_hz
            + FRAME_LATENCY_S,
            "approach": max(drive_s, unfold_s),
            "reach": self._servos_s(behind, around),
            "grasp": self._servos_s(claws, dict.fromkeys(claws, 0.0)),
            "lift": self._servos_s(around, up),
            "hold": Limits().hold_s,
        }

    def _joints(self, pose: HandPose) -> dict[str, float]:
        robot = self._robot
        level = {robot.arm.azimuth: 0.0, robot.arm.roll: robot.claw.level_roll_rad}
        start = robot.poses["unfolded"] | level
        solved = self._actuators.reacher.solve(start, pose)
        if solved is None:
            raise ValueError(f"the arm does not reach {pose}")
        return solved

    def _servos_s(self, start: Mapping[str, float], end: Mapping[str, float]) -> float:
        """Least time of a motion in which all joints go at once."""
        joints = self._robot.joints
        return max(abs(end[name] - start[name]) / joints[name].max_speed_radps for name in end if name in start)


def rehearsed(case: FetchCase) -> dict[str, Any]:
    """The result of a case's rehearsal, with the time of each phase by its name."""
    from apps.rehearsal.rehearse import rehearse

    request = RehearsalRequest(
        task=FetchTask(label=case.label), scene="paper", sensors="real", seed=case.seed,
        width=case.width, height=case.height, frame_rate_hz=case.rate_hz,
    )  # fmt: skip
    result = rehearse(request)
    seconds = dict.fromkeys(PHASES, 0.0)
    for phase in result["phases"]:
        seconds[phase["name"]] = seconds.get(phase["name"], 0.0) + phase["sim_s"]
    return {**result, "seconds": seconds}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=10, help="each with the three cans (10)")
    parser.add_argument("--small", action="store_true", help="frames of 320 x 240 at 15 Hz, four times as fast")
    parser.add_argument("--jobs", type=int, default=2, help="rehearsals at once (2); the figures do not depend on it")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    frames = (320, 240, 15.0) if chosen.small or chosen.short else (640, 480, 30.0)
    seeds = range(1 if chosen.short else chosen.seeds)
    cases = [FetchCase(label, seed, *frames) for seed in seeds for label in PAPER]
    with ProcessPoolExecutor(chosen.jobs) as pool:
        results = list(pool.map(rehearsed, cases))
    good = [result for result in results if result["outcome"] == "done" and result["truth"]["held"]]
    knocked = sum(bool(result["truth"]["knocked_over"]) for result in results)
    report.value("fetch, paper's scene", [result["sim_s"] for result in results], "s", at_most=MOST_S)
    report.share("fetches whose can was held", len(good), len(results), at_least=len(results))
    report.share("fetches that knocked nothing over", len(results) - knocked, len(results), at_least=len(results))
    limits = FetchLimits(Robot.load())
    for label in PAPER:
        here = [result for case, result in zip(cases, results, strict=True) if case.label == label]
        report.tables.append(Table(f"Phases, {label}, s", HEAD, list(rows(label, here, limits))))


HEAD = ["phase", "median", "middle 80%", "limit", "what makes the difference"]


def rows(label: str, results: list[dict[str, Any]], limits: FetchLimits) -> Iterator[list[str]]:
    """The table of one can: each phase, and all of them."""
    known = find_scene("paper", 0, label, "").object(label)
    x, y = known.position_m[:2]
    least = limits.of((x, y, known.dimensions_m[1] / 2))
    for phase in PHASES:
        median, low, high, _ = spread(phase, [result["seconds"][phase] for result in results])
        yield [phase, number(median), f"{number(low)} to {number(high)}", number(least[phase]), WAITS[phase]]
    median, low, high, _ = spread("all", [result["sim_s"] for result in results])
    yield ["all", number(median), f"{number(low)} to {number(high)}", number(sum(least.values())), ""]
