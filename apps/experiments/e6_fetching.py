"""E6: the robot finds one of three cans, drives there, grasps it and lifts it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import ceil
from typing import Any

from apps.experiments import figures, plan
from apps.experiments.carry_out import RunResult
from apps.experiments.plan import ExperimentSettings
from apps.experiments.results import Plot, Section, row
from apps.experiments.runs import ExperimentRun
from services.executive.tasks import FetchTask

KEY, TITLE = "E6", "Fetching"
CANS = ("red_can", "green_can", "blue_can")
SHARE = 28 / 30
WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    "learned": ("ours: the learned map", {}),
    "rigid": ("baseline: rigid body as drawn", {"model": None}),
    "calibrated": ("baseline: rigid body, calibrated", {"rigid": True}),
    "lockstep": ("baseline: learned map, lock-step", {"lockstep": True}),
}


def runs(settings: ExperimentSettings) -> list[ExperimentRun]:
    found = []
    for seed in settings.seeds:
        found += [*plan.learned(settings, seed), plan.calibrated(settings, seed)]
        for way, (_, fields) in WAYS.items():
            for can in CANS:
                name = f"fetch-{way}-{can}-{seed}"
                found.append(plan.with_model(settings, seed, name, task=FetchTask(label=can), **fields))
    return found


def section(settings: ExperimentSettings, results: Mapping[str, RunResult]) -> Section:
    made = Section(
        KEY,
        TITLE,
        "The paper's scene: three cans at (1.5 m, 0°), (1.4 m, -45°) and (1 m, 45°), within 2 cm by the seed. A can"
        " counts as fetched when it is truly held 0.1 m high for 2 s and no can was knocked over.",
    )
    total = len(settings.seeds) * len(CANS)
    phases: dict[str, list[RunResult]] = {}
    for way, (who, _) in WAYS.items():
        found = [results[f"fetch-{way}-{can}-{seed}"] for seed in settings.seeds for can in CANS]
        good = [result for result in found if _fetched(result)]
        knocked = sum(bool(result.get("truth", {}).get("knocked_over")) for result in found)
        least = ceil(SHARE * total)
        ours = way == "learned"
        made.rows += [
            row(f"fetched, of {total}", who, [], "", text=str(len(good)),
                wanted=f"at least {least}" if ours else "", held=len(good) >= least if ours else None,
                paper="the real robot knocked some targets over" if ours else ""),
            row("runs in which something was knocked over", who, [], "", text=str(knocked)),
            row("time of a fetch", who, [result["sim_s"] for result in good], "s"),
        ]  # fmt: skip
        phases[who] = good
        for result in found:
            if result not in good:
                why = result.get("error") or result.get("reason") or "not held in truth"
                made.notes.append(
                    f"Not fetched, {who}: {result.get('label', '?')}, seed {result.get('seed', '?')}: {why}."
                )
    if any(phases.values()):
        made.plots.append(
            Plot("e6-phases", "Mean duration of each phase, over the fetches whose can was held.",
                 partial(figures.phases, phases))
        )  # fmt: skip
    return made


def _fetched(result: RunResult) -> bool:
    truth = result.get("truth", {})
    return bool(result.get("outcome") == "done" and truth["held"] and not truth["knocked_over"])
