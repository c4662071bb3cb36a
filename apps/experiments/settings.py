"""Settings of the experiments, and the files of each seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from apps.rehearsal.request import BodyKind, Sensors
from cocoro.robot import Robot


def load_robot(description: str | None = None, measured: str | None = None) -> Robot:
    """The robot of these files; the Calliope where none is given. Raises ConfigError naming file and field."""
    return Robot.load(*(None if file is None else Path(file) for file in (description, measured)))


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
