"""The runs that all others need: each seed's body babbles and learns."""

from __future__ import annotations

from typing import Any

from apps.experiments.runs import ExperimentRun
from apps.experiments.settings import ExperimentSettings
from services.executive.tasks import BabbleArmTask, BabbleWheelsTask


def babbled(settings: ExperimentSettings, seed: int) -> list[ExperimentRun]:
    """Babbling of one body's arm and wheels."""
    common = settings.common(seed)
    arm = {"task": BabbleArmTask(count=settings.samples), "samples": str(settings.arm_file(seed)), **common}
    wheels = {
        "task": BabbleWheelsTask(label="red_can", count=settings.trials), "scene": "wheels",
        "samples": str(settings.wheels_file(seed)), **common,
    }  # fmt: skip
    return [
        ExperimentRun(f"babble-arm-{seed}", "rehearse", arm),
        ExperimentRun(f"babble-wheels-{seed}", "rehearse", wheels),
    ]


def learned(settings: ExperimentSettings, seed: int) -> list[ExperimentRun]:
    """Babbling of one body, and learning its model."""
    fields = {
        "arm": str(settings.arm_file(seed)), "wheels": str(settings.wheels_file(seed)),
        "into": str(settings.model_file(seed)), **settings.robot_files,
    }  # fmt: skip
    runs = babbled(settings, seed)
    return [*runs, ExperimentRun(learned_name(seed), "learn", fields, needs=tuple(run.name for run in runs))]


def learned_name(seed: int) -> str:
    return f"learn-{seed}"


def with_model(settings: ExperimentSettings, seed: int, name: str, **fields: Any) -> ExperimentRun:
    """A rehearsal with the model of a body; `fields` are further fields of the request."""
    request = {**settings.common(seed), "model": str(settings.model_file(seed)), **fields}
    return ExperimentRun(name, "rehearse", request, needs=(learned_name(seed),))
