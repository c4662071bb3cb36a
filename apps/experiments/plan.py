"""Settings of the experiments, the files of each seed, and the runs that all experiments need."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from apps.experiments.lessons import load_robot
from apps.experiments.runs import ExperimentRun
from cocoro.robot import Robot
from services.executive.tasks import BabbleArmTask, BabbleWheelsTask
from sim.kinds import BodyKind, Sensors


class ExperimentSettings(msgspec.Struct, frozen=True, kw_only=True):
    seeds: tuple[int, ...]
    out: Path
    sensors: Sensors = "real"
    body: BodyKind = "worn"
    description: str | None = None
    """File of a robot description in place of the Calliope's."""
    measured: str | None = None
    """File of the values measured on one robot; they replace the description's."""
    width: int = 640
    height: int = 480
    frame_rate_hz: float = 30.0
    samples: int = 2600
    """Samples of the arm's babbling; four fifths of them, a little over 2,000, are for learning."""
    trials: int = 40
    """Trials of the wheels' babbling."""
    jobs: int = 1
    """Runs at the same time."""

    def common(self, seed: int) -> dict[str, Any]:
        """Fields of every rehearsal's request."""
        return {
            "seed": seed, "sensors": self.sensors, "body": self.body, "width": self.width, "height": self.height,
            "frame_rate_hz": self.frame_rate_hz, **self.robot_files,
        }  # fmt: skip

    @property
    def robot_files(self) -> dict[str, str]:
        """The files that were given, by the name of their option."""
        files = {"description": self.description, "measured": self.measured}
        return {name: file for name, file in files.items() if file is not None}

    def robot(self) -> Robot:
        """Raises ConfigError naming file and field."""
        return load_robot(**self.robot_files)

    def arm_file(self, seed: int) -> Path:
        return self.out / "data" / f"seed-{seed}" / "arm.jsonl"

    def bent_file(self, seed: int) -> Path:
        return self.out / "data" / f"seed-{seed}" / "bent.jsonl"

    def wheels_file(self, seed: int) -> Path:
        return self.out / "data" / f"seed-{seed}" / "wheels.jsonl"

    def model_file(self, seed: int) -> Path:
        return self.out / "models" / f"seed-{seed}.json"

    def rigid_file(self, seed: int) -> Path:
        return self.out / "models" / f"seed-{seed}.rigid.json"


# --- the runs that all experiments need ------------------------------------------------------------


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


def learned_wheels(settings: ExperimentSettings, seed: int) -> list[ExperimentRun]:
    """Babbling of one body's wheels, and learning the distance between them; the arm's babbling takes far longer."""
    fields = {
        "trials": str(settings.wheels_file(seed)), "into": str(settings.model_file(seed).with_suffix(".wheels.json")),
        **settings.robot_files,
    }  # fmt: skip
    run = babbled(settings, seed)[1]
    return [run, ExperimentRun(wheels_name(seed), "learn-wheels", fields, needs=(run.name,))]


def wheels_name(seed: int) -> str:
    return f"learn-wheels-{seed}"


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


def calibrated(settings: ExperimentSettings, seed: int) -> ExperimentRun:
    """Calibrating the rigid body of one body, from the same samples; it needs the runs of `learned`."""
    fields = {
        "arm": str(settings.arm_file(seed)), "wheels": str(settings.wheels_file(seed)),
        "into": str(settings.rigid_file(seed)), **settings.robot_files,
    }  # fmt: skip
    return ExperimentRun(f"learn-rigid-{seed}", "learn-rigid", fields, needs=(learned_name(seed),))


def with_model(
    settings: ExperimentSettings, seed: int, name: str, *, rigid: bool = False, **fields: Any
) -> ExperimentRun:
    """A rehearsal with the model of a body, or with its calibrated rigid body; `fields` are further fields of the
    request."""
    file = settings.rigid_file(seed) if rigid else settings.model_file(seed)
    request = {**settings.common(seed), "model": str(file), **fields}
    return ExperimentRun(name, "rehearse", request, needs=(f"learn-rigid-{seed}" if rigid else learned_name(seed),))
