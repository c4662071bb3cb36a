"""`cocoro learn`: from samples to a model, with every way of learning measured on samples that it has not seen."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from cocoro.cli.link import Where, joined
from cocoro.cli.table import table
from cocoro.errors import ConfigError, RefusedError
from cocoro.learning import dataset, model, study
from cocoro.learning.dataset import HandRow, WheelRow
from cocoro.learning.drawing import Drawing
from cocoro.learning.model import Model, Training, WheelModel
from cocoro.learning.study import METHODS, Method, Score, Sightings
from cocoro.learning.wheels import WheelFit, fit_wheels
from cocoro.messages import ModelRequest
from cocoro.robot import Robot
from cocoro.topics import LEARNED

LEAST_SAMPLES = 50
CURVE = (100, 300, 1000, 2000)


@dataclass(frozen=True)
class Report:
    """What came of the arm's samples."""

    samples: int
    outliers: int
    draws: int
    scores: list[Score]
    """Of the baselines first."""
    chosen: Method
    curve: dict[int, float]
    """Held-out error of the chosen method, metres, after so many samples."""

    def data(self) -> dict[str, Any]:
        return {
            "samples": self.samples, "outliers": self.outliers, "draws": self.draws, "chosen": self.chosen.name,
            "scores": [{k: None if v != v else v for k, v in score._asdict().items()} for score in self.scores],
            "curve": {str(size): error for size, error in self.curve.items()},
        }  # fmt: skip

    def text(self) -> str:
        heads = ("", "held out, mm", "95 of 100, mm", "cross-validated, mm", "fit, s")
        rows = [
            (
                ("> " if score.name == self.chosen.name else "  ") + score.name,
                _mm(score.held_out_m),
                _mm(score.held_out_95_m),
                _mm(score.cross_validated_m),
                f"{score.fit_s:.2f}" if score.fit_s else "",
            )
            for score in self.scores
        ]
        after = ", ".join(f"{_mm(error)} mm after {size}" for size, error in self.curve.items())
        return (
            f"{self.samples} samples of {self.draws} draws, {self.outliers} outliers left out;"
            f" every {study.HELD_OUT}th draw is held out\n\n"
            + table(heads, rows)
            + f"\n{self.chosen.name}: held-out error {after}\n"
        )


def learn_arm(
    samples: Path, into: Path, robot: Robot, *, search: bool, method: str | None, as_json: bool
) -> tuple[Model, str]:
    """Fit every method, choose, write the model; returns it with what is to be printed. Raises ConfigError."""
    recorded = dataset.read(samples, HandRow, robot)
    rows = recorded.rows
    if len(rows) < LEAST_SAMPLES:
        raise ConfigError(f"samples {samples}: {len(rows)} are too few to learn from; {LEAST_SAMPLES} are the least")
    drawing = Drawing(robot, recorded.header.roll_rad)
    seen = Sightings(
        np.array([row.angles_rad for row in rows]),
        np.array([row.seen_m for row in rows]),
        np.array([row.draw for row in rows]),
    )
    kept = study.clean(seen, drawing)
    learn, held = study.split(kept)
    if not len(held):
        raise ConfigError(f"samples {samples}: {study.HELD_OUT} draws at least are needed to hold one out")
    methods = _methods(search, method)
    scores = [study.score(one, drawing, learn, held) for one in methods]
    chosen = study.best(scores, methods)
    sizes = [*[size for size in CURVE if size < len(learn)], len(learn)]
    curve_m = study.curve(chosen, drawing, learn, held, sizes)
    report = Report(
        samples=len(kept), outliers=len(seen) - len(kept), draws=len(np.unique(kept.draws)),
        scores=[*study.baselines(drawing, learn, held), *scores], chosen=chosen,
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
    learned = study.fit(chosen, drawing, kept)  # what is used learns from the held-out draws too
    arm = model.arm_model(learned, recorded.header.roll_rad, kept.places_m, training)
    made = msgspec.structs.replace(_before(into, robot), arm=arm)
    model.save(made, into)
    return made, json.dumps(report.data() | {"model": str(into)}) if as_json else report.text() + f"\n{into} is written"


def learn_wheels(samples: Path, into: Path, robot: Robot, *, as_json: bool) -> tuple[Model, str]:
    """Fit the distance of the wheels, write the model; as `learn_arm`."""
    recorded = dataset.read(samples, WheelRow, robot)
    fit = fit_wheels(recorded.rows)
    if fit is None:
        raise ConfigError(f"samples {samples}: no trial in it turned far enough to tell the wheels' distance")
    scores = {"sigma_m": fit.sigma_m, "median_m": fit.median_m}
    training = Training(
        data=recorded.fingerprint, samples=len(recorded.rows), method="all trials at once",
        scores={name: value for name, value in scores.items() if not isnan(value)},
    )  # fmt: skip
    made = msgspec.structs.replace(
        _before(into, robot), wheels=WheelModel(separation_m=fit.separation_m, training=training)
    )
    model.save(made, into)
    return made, _wheels_json(fit, into) if as_json else _wheels_text(fit, robot) + f"\n{into} is written"


async def send(where: Where, made: Model) -> str:
    """Have a running planner take the model over; what it says of it. Raises RefusedError when it would not."""
    async with joined(where) as link:
        reply = await link.call(LEARNED, ModelRequest(content=model.encode(made)))
    if not reply.accepted:
        raise RefusedError(reply.text)
    return f"{link.robot} has taken it over"


def _before(into: Path, robot: Robot) -> Model:
    """What the file holds already, so that arm and wheels can be learned one after the other."""
    return model.load(into, robot) if into.is_file() else model.empty(robot)


def _methods(search: bool, method: str | None) -> Sequence[Method]:
    methods = [*METHODS, *study.grid("in order"), *study.grid("least squares")] if search else list(METHODS)
    if method is None:
        return methods
    found = [one for one in methods if one.name == method]
    if not found:
        names = "\n  ".join(one.name for one in methods)
        raise ConfigError(f"there is no method {method!r}; known are\n  {names}")
    return found


def _mm(metres: float) -> str:
    return "" if isnan(metres) else f"{1000 * metres:.1f}"


def _wheels_text(fit: WheelFit, robot: Robot) -> str:
    drawn_m = robot.base.wheel_separation_m
    doubt = "" if isnan(fit.sigma_m) else f" +- {1000 * fit.sigma_m:.1f}"
    rows = [
        ("learned, from all trials at once", f"{1000 * fit.separation_m:.1f}{doubt}"),
        (f"the paper's median of {len(fit.estimates_m)} trials", f"{1000 * fit.median_m:.1f}"),
        ("the drawing", f"{1000 * drawn_m:.1f}"),
    ]
    scales = f"for a metre the left wheel rolls {fit.left_scale:.3f} m, the right one {fit.right_scale:.3f} m\n"
    return table(("", "wheel distance, mm"), rows) + scales


def _wheels_json(fit: WheelFit, into: Path) -> str:
    data = {
        "separation_m": fit.separation_m, "sigma_m": None if isnan(fit.sigma_m) else fit.sigma_m,
        "median_m": fit.median_m, "estimates_m": fit.estimates_m, "left_scale": fit.left_scale,
        "right_scale": fit.right_scale, "model": str(into),
    }  # fmt: skip
    return json.dumps(data)
