"""`cocoro learn`: from samples to a model, with every way of learning measured on samples that it has not seen."""

from __future__ import annotations

import json
import sys
from math import isnan
from pathlib import Path

from apps.cli.link import joined
from apps.cli.options import RobotChoice
from apps.cli.terminal import table
from apps.learning import lesson, study
from apps.learning.lesson import ArmReport
from apps.learning.wheels import WheelFit
from cocoro.errors import RefusedError
from cocoro.learning import model
from cocoro.learning.model import BodyModel
from cocoro.messages import ModelRequest
from cocoro.robot import Robot
from cocoro.topics import LEARNED


def learn_arm(
    samples: Path, into: Path, robot: Robot, *, search: bool, method: str | None, as_json: bool
) -> tuple[BodyModel, str]:
    """Learn, write the model; returns it with what is to be printed. Raises ConfigError."""
    shown = sys.stderr.isatty()

    def tell(text: str) -> None:
        if shown:
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    made, report = lesson.learn_arm(samples, into, robot, search=search, method=method, tell=tell)
    tell("")
    return made, json.dumps(report.data() | {"model": str(into)}) if as_json else _text(report) + f"\n{into} is written"


def learn_wheels(samples: Path, into: Path, robot: Robot, *, as_json: bool) -> tuple[BodyModel, str]:
    """Likewise."""
    made, fit = lesson.learn_wheels(samples, into, robot)
    return made, _wheels_json(fit, into) if as_json else _wheels_text(fit, robot) + f"\n{into} is written"


async def send(where: RobotChoice, made: BodyModel) -> str:
    """Have a running planner take the model over; what it says of it. Raises RefusedError when it would not."""
    async with joined(where) as link:
        reply = await link.call(LEARNED, ModelRequest(content=model.encode(made)))
    if not reply.accepted:
        raise RefusedError(reply.text)
    return f"{link.robot} has taken it over"


def _text(report: ArmReport) -> str:
    heads = ("", "held out, mm", "95 of 100, mm", "cross-validated, mm", "fit, s")
    rows = [
        (
            ("> " if score.name == report.chosen.name else "  ") + score.name,
            _mm(score.held_out_m),
            _mm(score.held_out_95_m),
            _mm(score.cross_validated_m),
            f"{score.fit_s:.2f}" if score.fit_s else "",
        )
        for score in report.scores
    ]
    after = ", ".join(f"{_mm(error)} mm after {size}" for size, error in report.curve.items())
    return (
        f"{report.samples} samples of {report.draws} draws, {report.outliers} outliers left out;"
        f" every {study.HELD_OUT}th draw is held out\n\n"
        + table(heads, rows)
        + f"\n{report.chosen.name}: held-out error {after}\n"
    )


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
