"""`cocoro learn`: from samples to a model, with every method measured on held-out samples."""

from __future__ import annotations

import asyncio
import json as json_module
import sys
from math import isnan
from pathlib import Path
from typing import Annotated

import typer

from apps.cli.link import joined
from apps.cli.options import (
    JsonOption,
    MeasuredOption,
    ModelOutOption,
    RobotChoice,
    RobotOption,
    SendOption,
    ThroughOption,
)
from apps.cli.terminal import StatusLine, table
from apps.learning import lesson, study
from apps.learning.lesson import ArmReport
from apps.learning.wheels import WheelFit
from cocoro.errors import RefusedError
from cocoro.learning.model import BodyModel, encode
from cocoro.messages import ModelRequest
from cocoro.robot import Robot
from cocoro.topics import LEARNED
from deploy.which_robot import files_here

app = typer.Typer()
learn = typer.Typer(no_args_is_help=True, help="Learn a model for the planner from the samples of babbling.")
app.add_typer(learn, name="learn")


@learn.command("arm")
def learn_arm(
    samples: Annotated[Path, typer.Argument(metavar="FILE", help="Samples of `cocoro babble arm`.")] = Path(
        "arm.jsonl"
    ),
    into: ModelOutOption = Path("model.json"),
    search: Annotated[bool, typer.Option("--search", help="Try a grid of bases, widths and rates, too.")] = False,
    method: Annotated[
        str | None, typer.Option(metavar="NAME", help="Use this method instead of the one with the smallest error.")
    ] = None,
    measured: MeasuredOption = None,
    send: SendOption = False,
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Learn the hand-eye map by every method, measure each on held-out samples, and write the best."""
    model, text = learn_arm_model(
        samples, into, files_here(robot).with_measured(measured).load(), search=search, method=method, as_json=json
    )
    print(text)
    if send:
        send_model(RobotChoice(robot, site), model, json)


@learn.command("wheels")
def learn_wheels(
    samples: Annotated[Path, typer.Argument(metavar="FILE", help="Trials of `cocoro babble wheels`.")] = Path(
        "wheels.jsonl"
    ),
    into: ModelOutOption = Path("model.json"),
    measured: MeasuredOption = None,
    send: SendOption = False,
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Learn the distance between the wheels."""
    model, text = learn_wheel_model(samples, into, files_here(robot).with_measured(measured).load(), as_json=json)
    print(text)
    if send:
        send_model(RobotChoice(robot, site), model, json)


def learn_arm_model(
    samples: Path, into: Path, robot: Robot, *, search: bool, method: str | None, as_json: bool
) -> tuple[BodyModel, str]:
    """Learns the arm and writes the model; returns it and the report as text.

    Raises ConfigError for a file of samples or a model file that cannot be used, or an unknown method.
    """
    with StatusLine(sys.stderr) as line:
        model, report = lesson.learn_arm(samples, into, robot, search=search, method=method, tell=line.show)
    if as_json:
        return model, json_module.dumps(report.data() | {"model": str(into)})
    return model, f"{_text(report)}\n{into} is written"


def learn_wheel_model(samples: Path, into: Path, robot: Robot, *, as_json: bool) -> tuple[BodyModel, str]:
    """Learns the wheels and writes the model; returns it and the report as text. Raises ConfigError."""
    model, fit = lesson.learn_wheels(samples, into, robot)
    return model, _wheels_json(fit, into) if as_json else f"{_wheels_text(fit, robot)}\n{into} is written"


def send_model(choice: RobotChoice, model: BodyModel, as_json: bool) -> None:
    """Sends the model to a running planner. Raises RefusedError when the planner does not accept it."""
    text = asyncio.run(_send(choice, model))
    print(text, file=sys.stderr if as_json else sys.stdout)


async def _send(choice: RobotChoice, model: BodyModel) -> str:
    async with joined(choice) as link:
        reply = await link.call(LEARNED, ModelRequest(content=encode(model)))
    if not reply.accepted:
        raise RefusedError(reply.text)
    return f"{link.robot} uses the model now"


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
    nominal_m = robot.base.axle_m
    doubt = "" if isnan(fit.sigma_m) else f" +- {1000 * fit.sigma_m:.1f}"
    rows = [
        ("learned, from all trials at once", f"{1000 * fit.separation_m:.1f}{doubt}"),
        (f"the paper's median of {len(fit.estimates_m)} trials", f"{1000 * fit.median_m:.1f}"),
        ("the nominal model", f"{1000 * nominal_m:.1f}"),
    ]
    scales = (
        f"for a commanded metre the left wheel rolls {fit.left_scale:.3f} m, the right one {fit.right_scale:.3f} m\n"
    )
    return table(("", "wheel distance, mm"), rows) + scales


def _wheels_json(fit: WheelFit, into: Path) -> str:
    data = {
        "separation_m": fit.separation_m, "sigma_m": None if isnan(fit.sigma_m) else fit.sigma_m,
        "median_m": fit.median_m, "estimates_m": fit.estimates_m, "left_scale": fit.left_scale,
        "right_scale": fit.right_scale, "model": str(into),
    }  # fmt: skip
    return json_module.dumps(data)
