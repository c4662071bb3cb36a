"""E3: the robot babbles with its wheels and learns the distance between them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from apps.experiments import figures, plan
from apps.experiments.carry_out import RunResult
from apps.experiments.plan import ExperimentSettings
from apps.experiments.results import Plot, ResultRow, Section, row
from apps.experiments.runs import ExperimentRun

KEY, TITLE = "E3", "The distance between the wheels, from babbling"
MEDIAN_M, WORST_M = 0.003, 0.008


def runs(settings: ExperimentSettings) -> list[ExperimentRun]:
    return [run for seed in settings.seeds for run in plan.learned_wheels(settings, seed)]


def section(settings: ExperimentSettings, results: Mapping[str, RunResult]) -> Section:
    good = [
        (results[plan.wheels_name(seed)]["wheels"], results[f"babble-wheels-{seed}"]["body"])
        for seed in settings.seeds
        if "error" not in results[plan.wheels_name(seed)]
    ]
    made = Section(
        KEY,
        TITLE,
        f"A can 1.5 m ahead; {settings.trials} trials, in pairs of a Sobol draw within ±0.15 m/s for each wheel for 1 s"
        " and its reverse. The can is seen before and after each.",
    )
    nominal_m = settings.robot().base.axle_m
    for measure, key in (("wheel distance", "wheel_separation_m"), ("distance that turns it", "turning_separation_m")):
        axle = key == "wheel_separation_m"
        true_m = [body[key] for _, body in good]
        ours_m = [fit["separation_m"] * (_scale(fit) if axle else 1.0) for fit, _ in good]
        made.rows += [
            _row(measure, "ours: all trials at once", ours_m, true_m, wanted=axle),
            _row(measure, "the paper's median over the trials", [fit["median_m"] for fit, _ in good], true_m,
                 paper="6 cm (real) and 5 cm (virtual) over the true distance" if axle else ""),
            _row(measure, "baseline: the nominal model", [nominal_m] * len(good), true_m),
        ]  # fmt: skip
    made.notes.append(
        "The wheel distance is the distance between the axle's ends. Wheels that roll up to 2% more or less than"
        " commanded turn the robot as if they stood nearer together or further apart; odometry and navigation need and"
        " use the distance that turns it. Our value for the axle is that distance without the learned scale of the"
        " wheels."
    )
    if good:
        turning = [(fit, body["turning_separation_m"]) for fit, body in good]
        made.plots.append(
            Plot("e3-trials", "Error of the distance that turns the robot: of the fit to all trials so far, a line for"
                 " each seed; and of the single trials' own estimates.",
                 partial(figures.wheel_trials, turning))
        )  # fmt: skip
    return made


def _scale(fit: Mapping[str, Any]) -> float:
    return float(fit["left_scale"] + fit["right_scale"]) / 2


def _row(
    measure: str, who: str, found_m: list[float], true_m: list[float], *, wanted: bool = False, paper: str = ""
) -> ResultRow:
    mm = [1000 * abs(one - true) for one, true in zip(found_m, true_m, strict=True)]
    found = row(f"error of the {measure}", who, mm, "mm", paper=paper)
    text = f"{found.mean}, median {found.values.median:.1f}"
    held = found.values.median <= 1000 * MEDIAN_M and found.values.worst <= 1000 * WORST_M if wanted and mm else None
    return found._replace(text=text, held=held, wanted="median at most 3, worst at most 8" if wanted else "")
