"""E1: the arm babbles and learns the map from joint angles to the hand's place; then it is bent, and the map adapts."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from apps.experiments import figures, plan
from apps.experiments.carry_out import RunResult
from apps.experiments.lessons import CURVES, SIZES
from apps.experiments.plan import ExperimentSettings
from apps.experiments.results import Plot, Section, row
from apps.experiments.runs import ExperimentRun
from apps.learning.study import BEST, METHODS, PAPER, RIGID
from services.executive.tasks import BabbleArmTask

KEY, TITLE = "E1", "The hand-eye map, from babbling"
BEND_S = 30.0
"""Simulated time at which the forearm is bent."""
BENT_SAMPLES = 450
AFTER = 100
"""Number of sightings after the bend that are left out when the adapted map is judged."""


def runs(settings: ExperimentSettings) -> list[ExperimentRun]:
    found = []
    for seed in settings.seeds:
        found += plan.learned(settings, seed)
        bent = {
            "task": BabbleArmTask(count=BENT_SAMPLES), "samples": str(settings.bent_file(seed)), "bend_s": BEND_S,
            **settings.common(seed),
        }  # fmt: skip
        lesson = {"into": str(settings.model_file(seed)), "bent": str(settings.bent_file(seed)), "bend_s": BEND_S}
        lesson |= settings.robot_files
        found.append(ExperimentRun(f"babble-bent-{seed}", "rehearse", bent))
        found.append(
            ExperimentRun(f"bend-{seed}", "bend", lesson, needs=(f"babble-bent-{seed}", plan.learned_name(seed)))
        )
    return found


def section(settings: ExperimentSettings, results: Mapping[str, RunResult]) -> Section:
    learned = {seed: results[plan.learned_name(seed)] for seed in settings.seeds}
    good = {seed: result for seed, result in learned.items() if "error" not in result}
    bent = [r for seed in settings.seeds if "error" not in (r := results[f"bend-{seed}"])]
    made = Section(KEY, TITLE, _about(good))
    by_name = {seed: {s["name"]: s for s in result["arm"]["scores"]} for seed, result in good.items()}
    chosen = [by_name[seed][result["arm"]["chosen"]]["held_out_m"] for seed, result in good.items()]
    baseline = [scores["the nominal model with its best constant offset"]["held_out_m"] for scores in by_name.values()]
    cm = [100 * value for value in chosen]
    ratio = [ours / theirs for ours, theirs in zip(chosen, baseline, strict=True)]
    measure = "held-out error, RMS"
    made.rows.append(
        row(measure, "ours: the map that measures best", cm, "cm", digits=2, wanted="at most 0.6 in each seed",
            held=bool(cm) and max(cm) <= 0.6)
    )  # fmt: skip
    made.rows.append(
        row(
            measure,
            "baseline: the nominal model and its best constant hand offset",
            [100 * error for error in baseline],
            "cm",
            digits=2,
        )
    )
    made.rows.append(
        row("share of that baseline's error", "ours", ratio, "", digits=2, wanted="at most 0.6 in each seed",
            held=bool(ratio) and max(ratio) <= 0.6)
    )  # fmt: skip
    for name in (PAPER.name, RIGID[-1].name):
        over = [scores[name]["held_out_m"] for scores in by_name.values() if name in scores]
        if len(over) == len(chosen):
            shares = [ours / theirs for ours, theirs in zip(chosen, over, strict=True)]
            made.rows.append(row(f"share of the error of: {name}", "ours", shares, "", digits=2))
    best = [100 * min(r["readings"].values()) for r in good.values() if r["readings"]]
    made.rows.append(
        row(measure, "the paper's rule, whichever allowed reading is best for the body", best, "cm", digits=2)
    )
    for name in ("the nominal model", *(method.name for method in (*RIGID, *METHODS))):
        values = [100 * scores[name]["held_out_m"] for scores in by_name.values() if name in scores]
        rigid = name == "the nominal model" or name in {method.name for method in RIGID}
        who = "ours, the default: " if name == BEST.name else "baseline: " if rigid else ""
        paper = "seen almost 10 cm nearer than the model" if name == "the nominal model" else ""
        made.rows.append(row(measure, who + name, values, "cm", digits=2, paper=paper))
    for key, who in {
        key: "ours, the default" if key == "default" else method.name for key, method in CURVES.items()
    }.items():
        for size in SIZES:
            values = [100 * r["curves"][key][str(size)] for r in good.values() if str(size) in r["curves"][key]]
            made.rows.append(row(f"held-out error after {size:,} samples", who, values, "cm", digits=2))
    made.rows += _bent_rows(bent)
    made.plots = _plots(settings, good, bent)
    return made


def _about(good: Mapping[int, RunResult]) -> str:
    text = (
        "The arm moves from Sobol draw to Sobol draw over its joints' range (±2.62 rad, within the joints' limits), the"
        " head looks at the hand's marker, and each frame that shows the marker is a sample. Every fifth draw is held"
        " out with all its samples; the maps learn from the rest and are judged on the held-out ones."
    )
    if not good:
        return text
    share = sum(r["draws_used"] / r["draws_looked_at"] for r in good.values()) / len(good)
    babbled_s = sum(r["babbled_s"] for r in good.values()) / len(good)
    learn = sum(r["learn"] for r in good.values()) / len(good)
    return text + (
        f" {share:.0%} of the draws are used: those that a safe path reaches and at which the marker can be seen. A"
        f" seed's samples took {babbled_s / 60:.1f} simulated minutes; {learn:.0f} of them are for learning."
    )


def _bent_rows(bent: list[RunResult]) -> list[Any]:
    def mean_cm(values: list[float]) -> float:
        return 100 * sum(values) / max(len(values), 1)

    def late(result: RunResult, key: str) -> float:
        return mean_cm(result[key][result["bent_at"] + AFTER :])

    measure = f"error {AFTER} sightings after the arm was bent by 3 cm, and later"
    return [
        row("error before the bend", "ours", [mean_cm(r["fixed_m"][: r["bent_at"]]) for r in bent], "cm", digits=2),
        row(measure, "ours, trained further (--adapt)", [late(r, "adapted_m") for r in bent], "cm", digits=2),
        row(measure, "baseline: the map, fixed", [late(r, "fixed_m") for r in bent], "cm", digits=2),
    ]


def _plots(settings: ExperimentSettings, good: Mapping[int, RunResult], bent: list[RunResult]) -> list[Plot]:
    plots = []
    if good:
        seed = next(iter(good))
        plots.append(
            Plot("e1-hand", f"The hand on the held-out draws of seed {seed}: seen, by the nominal model, and by the"
                 " learned map.",
                 partial(figures.hand_places, settings.arm_file(seed), settings.model_file(seed), settings.robot()))
        )  # fmt: skip
        curves = [result["curves"] for result in good.values()]
        plots.append(Plot("e1-curves", "Held-out error against samples; the mean over the seeds, and all seeds.",
                          partial(figures.curves, curves)))  # fmt: skip
    if bent:
        plots.append(Plot("e1-bend", "Error of each sighting when the forearm is bent by 3 cm at the hand (dotted): the"
                          " map that is trained further, and the fixed one; the median over the seeds, smoothed.",
                          partial(figures.bend, bent)))  # fmt: skip
    return plots
