"""E5: a ball is carried round a square, and the robot follows it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from apps.experiments import figures, plan
from apps.experiments.carry_out import RunResult
from apps.experiments.plan import ExperimentSettings
from apps.experiments.results import Plot, Section, row
from apps.experiments.runs import ExperimentRun
from services.executive.tasks import FollowTask

KEY, TITLE = "E5", "Following"
FOR_S = 33.0
"""Time of one round: 8 m at 0.25 m/s, and a little more."""
LOST_S = 1.0
"""Longest acceptable time without the ball in the picture."""
WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    "learned": ("ours", {}),
    "lockstep": ("baseline: lock-step", {"lockstep": True}),
}


def runs(settings: ExperimentSettings) -> list[ExperimentRun]:
    found = []
    for seed in settings.seeds:
        found += plan.learned(settings, seed)
        for way, (_, fields) in WAYS.items():
            request = {
                "task": FollowTask(label="blue_ball", for_s=FOR_S),
                "scene": "follow",
                "trace": seed == settings.seeds[0],
            }
            found.append(plan.with_model(settings, seed, f"follow-{way}-{seed}", **{**request, **fields}))
    return found


def section(settings: ExperimentSettings, results: Mapping[str, RunResult]) -> Section:
    made = Section(
        KEY,
        TITLE,
        "A ball, 0.7 m high, starts 1 m ahead and is carried round a square of 8 m at 0.25 m/s. Gaps are from the"
        " robot's centre to the ball's nearest edge; lost is the longest time without the ball in the picture."
        " All values are the simulator's truth.",
    )
    for way, (who, _) in WAYS.items():
        truths = [r["truth"] for s in settings.seeds if (r := results[f"follow-{way}-{s}"]).get("outcome") == "done"]
        lost = [truth["lost_s"] for truth in truths]
        ours = way == "learned"
        paper = "pursuit kept all round, overshoot at the turns" if ours else ""
        held = len(truths) == len(settings.seeds) and max(lost, default=0.0) <= LOST_S if ours else None
        made.rows += [
            row("mean gap", who, [truth["mean_gap_m"] for truth in truths], "m", digits=2, paper=paper),
            row("widest gap", who, [truth["max_gap_m"] for truth in truths], "m", digits=2),
            row("lost for", who, lost, "s", digits=2, wanted="never over 1" if ours else "", held=held),
            row("followed to the end, of " + str(len(settings.seeds)), who, [], "", text=str(len(truths))),
        ]
    seed = settings.seeds[0]
    traces = {WAYS[way][0]: result["trace"] for way in WAYS if "trace" in (result := results[f"follow-{way}-{seed}"])}
    if traces:
        made.plots.append(
            Plot("e5-square", f"The ball's square and the robot's path behind it, from above, seed {seed}.",
                 partial(figures.square, traces))
        )  # fmt: skip
    return made
