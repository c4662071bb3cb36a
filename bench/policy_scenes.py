"""One kind of scene for a policy: a red can ahead, and rehearsals in it, of the planner's fetch and of a policy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from math import cos, radians, sin
from pathlib import Path
from typing import Any, NamedTuple

from apps.captures.export.story import read
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import TRUTH
from services.executive.tasks import FetchTask, PolicyTask
from sim.judge import HELD_HEIGHT_M, Judge, Verdict
from sim.kinds import Sensors
from sim.scene import load_scene
from sim.seeds import stream

LABEL = "red_can"
DISTANCE_M = (0.9, 1.5)
BEARING_DEG = 20.0
"""The can stands at most so far to either side."""

Result = dict[str, Any]


class Case(NamedTuple):
    """A rehearsal that is to run."""

    folder: Path
    """Of scene files."""
    seed: int
    frames: dict[str, int | float]
    sensors: Sensors
    record: Path
    """Capture that it makes."""
    policy: str = ""
    """As a task names it; without one the planner fetches."""
    for_s: float = 0.0
    """How long the policy moves the robot."""


def scene_text(seed: int) -> str:
    """A scene file: a can at a distance and bearing drawn from the seed, in light drawn from it."""
    known = Catalogue.load().get(LABEL)
    assert known is not None
    draw = stream(seed, "policy bench")
    distance_m, bearing = draw.uniform(*DISTANCE_M), radians(draw.uniform(-BEARING_DEG, BEARING_DEG))
    ambient, temperature_k = draw.uniform(0.45, 0.65), draw.uniform(4500, 6500)
    return (
        'name = "can ahead"\n\n[[object]]\n'
        f'label = "{LABEL}"\nshape = "{known.shape}"\nradius_m = {known.radius_m}\nheight_m = {known.height_m}\n'
        f"position_m = [{distance_m * cos(bearing):.4f}, {distance_m * sin(bearing):.4f}]\n\n"
        f"[light]\nambient = {ambient:.3f}\ntemperature_k = {temperature_k:.0f}.0\n"
    )


def scene_file(case: Case) -> Path:
    return case.folder / f"can-{case.seed:06}.toml"


def rehearsed(case: Case) -> Result:
    """The result of a case's rehearsal."""
    from apps.rehearsal.rehearse import rehearse
    from apps.rehearsal.request import RehearsalRequest

    scene = scene_file(case)
    scene.write_text(scene_text(case.seed), encoding="utf-8")
    task = PolicyTask(label=case.policy, for_s=case.for_s) if case.policy else FetchTask(label=LABEL)
    fields: dict[str, Any] = dict(case.frames)
    request = RehearsalRequest(
        task=task, scene=str(scene), seed=case.seed, sensors=case.sensors,
        record=str(case.record), **fields,
    )  # fmt: skip
    return rehearse(request)


def all_rehearsed(cases: Sequence[Case], jobs: int) -> Iterator[tuple[Case, Result]]:
    """The cases with their results, in order; some are rehearsed at a time."""
    with ProcessPoolExecutor(jobs) as pool:
        yield from zip(cases, pool.map(rehearsed, cases), strict=True)


class Judged(NamedTuple):
    """What the simulator's truth says of a run."""

    verdict: Verdict
    lifted_s: float | None
    """Time from the run's start until the can was as high as one that is held; None where it never was."""

    @property
    def good(self) -> bool:
        """The can is held and lifted, and nothing else was touched or knocked over."""
        return self.verdict.held and not self.verdict.knocked_over and not self.verdict.collisions


def judged(robot: Robot, case: Case) -> Judged:
    """By a case's capture, since a rehearsal of a policy has no target to be judged by."""
    judge = Judge(robot, load_scene(scene_file(case), case.seed), LABEL)
    began_ns, lifted_s = None, None
    with Capture.open(case.record) as capture:
        for _, truth in read(capture, TRUTH):
            judge.feed(truth)
            began_ns = truth.stamp_ns if began_ns is None else began_ns
            if lifted_s is None and judge.result().lifted_m >= HELD_HEIGHT_M:
                lifted_s = (truth.stamp_ns - began_ns) / NS
    return Judged(judge.result(), lifted_s)
