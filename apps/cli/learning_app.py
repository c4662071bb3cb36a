"""`cocoro babble`, `cocoro learn` and `cocoro experiment`, and their options; `app` takes them in."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.cli.options import (
    DescriptionOption,
    JsonOption,
    MeasuredOption,
    MeshOption,
    ModelOutOption,
    RobotChoice,
    RobotOption,
    SamplesOutOption,
    SendOption,
)

if TYPE_CHECKING:
    from cocoro import robot as robots
    from cocoro.learning.model import BodyModel
    from services.executive.tasks import BabbleArmTask, BabbleWheelsTask

app = typer.Typer()
babble = typer.Typer(no_args_is_help=True, help="Move to learn: the arm before the eyes, the wheels before a target.")
learn = typer.Typer(no_args_is_help=True, help="Learn from what babbling saw: a model that the planner loads.")
app.add_typer(babble, name="babble")
app.add_typer(learn, name="learn")


@babble.command("arm")
def babble_arm(
    samples: Annotated[int, typer.Option(min=1, max=1_000_000, metavar="N", help="How many, all in all.")] = 1000,
    out: SamplesOutOption = Path("arm.jsonl"),
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """Move the arm about and look at the hand. Ctrl-C stops it; the same command goes on, and nothing is lost."""
    from services.executive.tasks import BabbleArmTask

    _babble(BabbleArmTask(), samples, out, robot, profile, json)


@babble.command("wheels")
def babble_wheels(
    trials: Annotated[int, typer.Option(min=1, max=100_000, metavar="N", help="How many, all in all.")] = 40,
    target: Annotated[
        str, typer.Option(metavar="LABEL", help="A known object that stands 1.5 m before the robot.")
    ] = "red_can",
    out: SamplesOutOption = Path("wheels.jsonl"),
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """Turn the wheels to and fro before a target. The robot needs half a metre around it. Ctrl-C stops it."""
    from services.executive.tasks import BabbleWheelsTask

    _babble(BabbleWheelsTask(label=target), trials, out, robot, profile, json)


def _babble(
    task: BabbleArmTask | BabbleWheelsTask,
    wanted: int,
    out: Path,
    robot: str | None,
    profile: str | None,
    as_json: bool,
) -> None:
    from apps.cli import babble as babbling

    sys.exit(asyncio.run(babbling.babble(RobotChoice(robot, profile), task, wanted, out, as_json)))


@learn.command("arm")
def learn_arm(
    samples: Annotated[Path, typer.Argument(metavar="FILE", help="What `babble arm` kept.")] = Path("arm.jsonl"),
    into: ModelOutOption = Path("model.json"),
    search: Annotated[bool, typer.Option("--search", help="A grid of bases, widths and rates too.")] = False,
    method: Annotated[
        str | None, typer.Option(metavar="NAME", help="This one, in place of the one that measures best.")
    ] = None,
    description: DescriptionOption = None,
    measured: MeasuredOption = None,
    send: SendOption = False,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """The hand-eye map: every way of learning it, measured on samples that it did not learn from; the best is kept."""
    from apps.cli import learn as learning

    made, text = learning.learn_arm(
        samples, into, _robot(description, measured), search=search, method=method, as_json=json
    )
    print(text)
    _send(send, made, robot, profile, json)


@learn.command("wheels")
def learn_wheels(
    samples: Annotated[Path, typer.Argument(metavar="FILE", help="What `babble wheels` kept.")] = Path("wheels.jsonl"),
    into: ModelOutOption = Path("model.json"),
    description: DescriptionOption = None,
    measured: MeasuredOption = None,
    send: SendOption = False,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """The distance between the wheels."""
    from apps.cli import learn as learning

    made, text = learning.learn_wheels(samples, into, _robot(description, measured), as_json=json)
    print(text)
    _send(send, made, robot, profile, json)


def _robot(description: Path | None, measured: Path | None) -> robots.Robot:
    from cocoro.robot import Robot

    return Robot.load(description, measured)


def _send(wanted: bool, made: BodyModel, robot: str | None, profile: str | None, as_json: bool) -> None:
    if wanted:
        from apps.cli import learn as learning

        text = asyncio.run(learning.send(RobotChoice(robot, profile), made))
        print(text, file=sys.stderr if as_json else sys.stdout)
