"""`cocoro babble`, `cocoro learn` and `cocoro experiment`, and their options; `app` takes them in."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apps.cli.options import (
    DescriptionOption,
    FramesOption,
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

PANEL = "Learning"

babble = typer.Typer(no_args_is_help=True, help="Move to learn: the arm before the eyes, the wheels before a target.")
learn = typer.Typer(no_args_is_help=True, help="Learn from what babbling saw: a model that the planner loads.")


def add_to(app: typer.Typer) -> None:
    app.add_typer(babble, name="babble", rich_help_panel=PANEL)
    app.add_typer(learn, name="learn", rich_help_panel=PANEL)
    app.command(rich_help_panel=PANEL)(experiment)


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


def experiment(
    which: Annotated[str, typer.Argument(metavar="E1|E2|E3|E4|E5|E6|all", help="Which of the paper's experiments.")],
    seeds: Annotated[int, typer.Option(min=1, max=1000, metavar="N", help="So many, from 0 on: a body each.")] = 10,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Report, plots, samples, models; what is there is not run again.")
    ] = Path("experiments"),
    sensors: Annotated[str, typer.Option(metavar="ideal|real", help="Perfect or real sensors.")] = "real",
    body: Annotated[str, typer.Option(metavar="nominal|worn", help="A body as drawn, or not.")] = "worn",
    frames: FramesOption = None,
    samples: Annotated[
        int, typer.Option(min=100, max=100_000, metavar="N", help="Of each body's babbling; a fifth is held out.")
    ] = 2600,
    jobs: Annotated[int | None, typer.Option(min=1, metavar="N", help="Runs at once; by default one a core.")] = None,
    no_plots: Annotated[bool, typer.Option("--no-plots", help="Tables alone, without matplotlib.")] = False,
) -> None:
    """Run the paper's experiments in virtual time and report them beside the paper's text and baselines.

    E1 hand-eye map, E2 reaching, E3 wheel distance, E4 navigation, E5 following, E6 fetching. Ctrl-C ends it; the same
    command goes on.
    """
    from apps.cli import experiment as experimenting

    sys.exit(experimenting.experiment(which, seeds, out, sensors, body, frames, samples, jobs, not no_plots))
