"""E2: the hand reaches four suspended targets in turn, three rounds."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from apps.experiments import figures, plan
from apps.experiments.carry_out import RunResult
from apps.experiments.plan import ExperimentSettings
from apps.experiments.results import Plot, ResultRow, Section, row
from apps.experiments.runs import ExperimentRun
from services.executive.tasks import TouchTask

KEY, TITLE = "E2", "Reaching four suspended targets"
TARGETS = ("red_can", "green_can", "blue_can", "yellow_ball")
ROUNDS = 3
ALL = len(TARGETS) * ROUNDS
STALL_S = 2.0
SCENES = {"targets": "in view", "targets-hidden": "marker hidden at the fourth"}
WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    "learned": ("ours: the learned map", {}),
    "calibrated": ("baseline: rigid body, calibrated", {"rigid": True}),
    "seen": ("baseline: rigid body as drawn, hand seen", {"reach": "rigid", "see_hand": True}),
    "rigid": ("baseline: rigid body as drawn", {"reach": "rigid"}),
}
REACHED = {"rho_m": 0.02, "azimuth_rad": 0.034, "elevation_rad": 0.034}


def runs(settings: ExperimentSettings) -> list[ExperimentRun]:
    found = []
    for seed in settings.seeds:
        found += [*plan.learned(settings, seed), plan.calibrated(settings, seed)]
        for scene in SCENES:
            for way, (_, fields) in WAYS.items():
                order = TARGETS * ROUNDS
                found.append(
                    plan.with_model(
                        settings, seed, _name(scene, way, seed), task=TouchTask(label=order[0]),
                        then=[TouchTask(label=label) for label in order[1:]], scene=scene,
                        trace=seed == settings.seeds[0], **fields,
                    )
                )  # fmt: skip
    return found


def section(settings: ExperimentSettings, results: Mapping[str, RunResult]) -> Section:
    made = Section(
        KEY,
        TITLE,
        "Two cans above, a can and a ball below; the open hand is moved around each in turn, twelve in all. A target is"
        " reached when hand and target, as the robot measures them, are within (0.02 m, 0.034 rad, 0.034 rad), the"
        " paper's measure. In the second scene an object near the camera hides the marker at the fourth target.",
    )
    for scene, about in SCENES.items():
        for way, (who, _) in WAYS.items():
            tasks = [results[_name(scene, way, seed)].get("tasks", []) for seed in settings.seeds]
            made.rows += _rows(about, who, tasks, ours=way == "learned")
    seed = settings.seeds[0]
    traces = {
        (way, scene): result["trace"]
        for way in ("learned", "seen")
        for scene in SCENES
        if "trace" in (result := results[_name(scene, way, seed)])
    }
    if len(traces) == 4:
        made.plots.append(
            Plot("e2-reach", f"The hand's true path in three rounds of seed {seed}, from above and from the side: with"
                 " the learned map, and with the rigid body whose hand is seen; marker in view and hidden.",
                 partial(figures.reaches, traces, [WAYS["learned"][0], WAYS["seen"][0]]))
        )  # fmt: skip
    return made


def _rows(about: str, who: str, tasks: list[list[dict[str, Any]]], *, ours: bool) -> list[ResultRow]:
    reached = [float(sum(task["outcome"] == "done" for task in seed)) for seed in tasks]
    stalls = [max((task["longest_stall_s"] for task in seed), default=float("nan")) for seed in tasks]
    gaps = [task["hand_to_target"] for seed in tasks for task in seed if task["outcome"] == "done"]
    truly = [
        float(sum(task["outcome"] == "done" and _truly(task["hand_to_target"]) for task in seed)) for seed in tasks
    ]
    paper = "no trouble on any segment" if ours else "stuck and jittering on the occluded one"
    return [
        row(f"reached of {ALL}, {about}", who, reached, "", best="high", wanted=f"{ALL} in each seed" if ours else "",
            held=min(reached) == ALL if ours else None, paper=paper),
        row(f"longest stall, {about}", who, stalls, "s", digits=2, wanted=f"at most {STALL_S:g}" if ours else "",
            held=max(stalls) <= STALL_S if ours else None),
        row(f"hand to target in truth, {about}", who, [1000 * gap["gap_m"] for gap in gaps], "mm"),
        row(f"of {ALL} within the paper's measure in truth, {about}", who, truly, "", best="high"),
    ]  # fmt: skip


def _truly(gap: dict[str, float]) -> bool:
    return all(abs(gap[name]) <= limit for name, limit in REACHED.items())


def _name(scene: str, way: str, seed: int) -> str:
    return f"{scene}-{way}-{seed}"
