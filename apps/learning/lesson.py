"""Learning of a model from samples: every method is measured on held-out samples, and the best one is kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from apps.learning import dataset, study
from apps.learning.dataset import HandRow, WheelRow
from apps.learning.method import Method
from apps.learning.sightings import Sightings
from apps.learning.study import METHODS, RIGID, Score
from apps.learning.wheels import WheelFit, fit_wheels
from cocoro.errors import ConfigError
from cocoro.learning import model
from cocoro.learning.handmap import NominalModel
from cocoro.learning.model import BodyModel, Training, WheelModel
from cocoro.robot import Robot
from services.planning.head import CameraTilt

LEAST_TRIALS = 4
"""Fewest trials that tell the camera's tilt."""
LEAST_SAMPLES = 50
CURVE = (100, 300, 1000, 2000)


@dataclass(frozen=True)
class ArmReport:
    """Results of learning from the arm's samples."""

    samples: int
    outliers: int
    draws: int
    scores: list[Score]
    """The baselines first."""
    chosen: Method
    curve: dict[int, float]
    """Held-out error of the chosen method, metres, by number of samples."""

    def data(self) -> dict[str, Any]:
        return {
            "samples": self.samples, "outliers": self.outliers, "draws": self.draws, "chosen": self.chosen.name,
            "scores": [{k: None if v != v else v for k, v in score._asdict().items()} for score in self.scores],
            "curve": {str(size): error for size, error in self.curve.items()},
        }  # fmt: skip


def sightings(rows: Sequence[HandRow]) -> Sightings:
    return Sightings(
        np.array([row.angles_rad for row in rows]),
        np.array([row.seen_m for row in rows]),
        np.array([row.draw for row in rows]),
    )


def learn_arm(
    samples: Path,
    into: Path,
    robot: Robot,
    *,
    search: bool = False,
    method: str | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> tuple[BodyModel, ArmReport]:
    """Fit every method (or `method` alone), choose one, and write the model into `into`.

    `tell` gets the progress. Raises ConfigError for bad or too few samples and for an unknown method.
    """
    recorded = dataset.read(samples, HandRow, robot)
    rows = recorded.rows
    if len(rows) < LEAST_SAMPLES:
        raise ConfigError(f"samples {samples}: {len(rows)} are too few; at least {LEAST_SAMPLES} are needed")
    nominal = NominalModel(robot, recorded.header.roll_rad)
    seen = sightings(rows)
    kept = study.clean(seen, nominal)
    learn, held = study.split(kept)
    if not len(held):
        raise ConfigError(f"samples {samples}: at least {study.HELD_OUT} draws are needed to hold one out")
    methods = _methods(search, method)
    scores = []
    for number, one in enumerate(methods, 1):
        tell(f"{number} of {len(methods)}: {one.name}")
        scores.append(study.score(one, nominal, learn, held, validate=one not in RIGID))
    chosen = study.best(scores, methods)
    sizes = [*[size for size in CURVE if size < len(learn)], len(learn)]
    curve_m = study.curve(chosen, nominal, learn, held, sizes)
    report = ArmReport(
        samples=len(kept), outliers=len(seen) - len(kept), draws=len(np.unique(kept.draws)),
        scores=[*study.baselines(nominal, learn, held), *scores], chosen=chosen,
        curve=dict(zip(sizes, curve_m, strict=True)),
    )  # fmt: skip
    own = next(score for score in scores if score.name == chosen.name)
    training = Training(
        data=recorded.fingerprint, samples=len(kept), method=chosen.name,
        scores={
            "held_out_rms_m": own.held_out_m, "held_out_95_m": own.held_out_95_m,
            "drawing_offset_rms_m": report.scores[1].held_out_m,
        },
    )  # fmt: skip
    learned = study.fit(chosen, nominal, kept)  # the model also learns from the held-out draws
    arm = model.arm_model(learned, recorded.header.roll_rad, kept.places_m, training)
    made = msgspec.structs.replace(_before(into, robot), arm=arm)
    model.save(made, into)
    return made, report


def learn_wheels(samples: Path, into: Path, robot: Robot) -> tuple[BodyModel, WheelFit]:
    """Fit the wheel distance and the camera's tilt, and write the model into `into`. Raises ConfigError."""
    recorded = dataset.read(samples, WheelRow, robot)
    fit = fit_wheels(recorded.rows)
    if fit is None:
        raise ConfigError(f"samples {samples}: no trial in it turned far enough to measure the wheel distance")
    scores = {"sigma_m": fit.sigma_m, "median_m": fit.median_m}
    training = Training(
        data=recorded.fingerprint, samples=len(recorded.rows), method="all trials at once",
        scores={name: value for name, value in scores.items() if not isnan(value)},
    )  # fmt: skip
    tilt_rad = camera_tilt(recorded.rows, recorded.header.target_height_m, robot)
    wheels = WheelModel(separation_m=fit.separation_m, eye_tilt_rad=tilt_rad or 0.0, training=training)
    made = msgspec.structs.replace(_before(into, robot), wheels=wheels)
    model.save(made, into)
    return made, fit


def _before(into: Path, robot: Robot) -> BodyModel:
    """The model in the file, so that arm and wheels can be learned one after the other."""
    return model.load(into, robot) if into.is_file() else model.empty(robot)


def _methods(search: bool, method: str | None) -> Sequence[Method]:
    methods = [*METHODS, *study.grid("in order"), *study.grid("least squares")] if search else list(METHODS)
    if method is None:
        return methods
    known = [*methods, *RIGID]
    found = [one for one in known if one.name == method]
    if not found:
        names = "\n  ".join(one.name for one in known)
        raise ConfigError(f"there is no method {method!r}; known are\n  {names}")
    return found


def camera_tilt(trials: Sequence[WheelRow], height_m: float | None, robot: Robot) -> float | None:
    """The camera's tilt, rad: the median over wheel trials whose target's centre is `height_m` high.

    None where the height is unknown, or too few trials have a seen height.
    """
    if height_m is None:
        return None
    nominal = CameraTilt(robot)
    found = [nominal.tilt_of((*row.after_m, row.height_m), height_m) for row in trials if row.height_m is not None]
    return float(np.median(found)) if len(found) >= LEAST_TRIALS else None
