"""Settings of the experiments, and the files of each seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from apps.rehearsal.request import BodyKind, Sensors


class ExperimentSettings(msgspec.Struct, frozen=True, kw_only=True):
    seeds: tuple[int, ...]
    out: Path
    sensors: Sensors = "real"
    body: BodyKind = "worn"
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
            "frame_rate_hz": self.frame_rate_hz,
        }  # fmt: skip

    def arm_file(self, seed: int) -> Path:
        return self.out / "data" / f"seed-{seed}" / "arm.jsonl"

    def bent_file(self, seed: int) -> Path:
        return self.out / "data" / f"seed-{seed}" / "bent.jsonl"

    def wheels_file(self, seed: int) -> Path:
        return self.out / "data" / f"seed-{seed}" / "wheels.jsonl"

    def model_file(self, seed: int) -> Path:
        return self.out / "models" / f"seed-{seed}.json"
