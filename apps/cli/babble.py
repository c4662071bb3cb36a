"""`cocoro babble`: the robot babbles; the samples that it publishes are kept in a file that a later run continues."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from msgspec.structs import replace

from apps.cli.link import MeshLink, joined
from apps.cli.options import JsonOption, RobotChoice, RobotOption, SamplesOutOption, ThroughOption
from apps.cli.output import print_json
from apps.cli.progress import TaskDisplay, task_display
from apps.cli.task_running import hands_on
from apps.cli.tasks import Follower
from apps.learning.collector import SampleCollector, collector
from cocoro.errors import CocoroError, MeshError
from cocoro.messages import AboutRequest, Message, ObjectsRequest, TaskRequest, TaskState
from cocoro.robot import Robot
from cocoro.topics import ABOUT, OBJECTS
from services.executive.tasks import BabbleArmTask, BabbleWheelsTask

BAR = 20
"""Characters of the progress bar."""

app = typer.Typer()
babble = typer.Typer(
    no_args_is_help=True,
    help="Move to collect samples for learning: the arm with the hand in view, the wheels with a target.",
)
app.add_typer(babble, name="babble")


@babble.command("arm")
def babble_arm(
    samples: Annotated[
        int, typer.Option(min=1, max=1_000_000, metavar="N", help="Number of samples that the file is to hold.")
    ] = 1000,
    out: SamplesOutOption = Path("arm.jsonl"),
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Move the arm about and look at the hand. Ctrl-C stops it; the same command continues, and no sample is lost."""
    sys.exit(asyncio.run(collect(RobotChoice(robot, site), BabbleArmTask(), samples, out, json)))


@babble.command("wheels")
def babble_wheels(
    trials: Annotated[
        int, typer.Option(min=1, max=100_000, metavar="N", help="Number of trials that the file is to hold.")
    ] = 40,
    target: Annotated[
        str, typer.Option(metavar="LABEL", help="A known object that stands 1.5 m in front of the robot.")
    ] = "red_can",
    out: SamplesOutOption = Path("wheels.jsonl"),
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Turn the wheels to and fro in front of a target. The robot needs half a metre around it. Ctrl-C stops it."""
    task = BabbleWheelsTask(label=target)
    sys.exit(asyncio.run(collect(RobotChoice(robot, site), task, trials, out, json)))


class BabbleDisplay:
    """Shows the samples with the task's progress: a bar, the coverage, and the time left at this rate."""

    def __init__(self, view: TaskDisplay, kept: SampleCollector[Any], wanted: int) -> None:
        self._view = view
        self._kept = kept
        self._wanted = wanted
        self._had = len(kept)

    def show(self, state: TaskState) -> None:
        if state.phase == state.task:
            state.text = self.text(state.elapsed_s)
        self._view.show(state)

    def say(self, text: str) -> None:
        self._view.say(text)

    def result(self, text: str) -> None:
        first, line_end, rest = text.partition("\n")
        self._view.result(f"{first}; {self._kept.summary}{line_end}{rest}")

    def close(self) -> None:
        self._view.close()

    def text(self, elapsed_s: float) -> str:
        count = len(self._kept)
        full = round(BAR * min(count / self._wanted, 1.0))
        new = count - self._had
        left = f", {_time((self._wanted - count) * elapsed_s / new)} left" if new else ""
        return f"[{'#' * full}{'.' * (BAR - full)}] {count} of {self._wanted}: {self._kept.summary}{left}"


class SampleWriter:
    """Writes samples into the file; cancels the task when the file takes no more, so that the robot stops."""

    def __init__(self, kept: SampleCollector[Any], cancel: Callable[[], None]) -> None:
        self.failure: OSError | None = None
        self._kept = kept
        self._cancel = cancel

    def take(self, message: Message) -> None:
        if self.failure is None:
            try:
                self._kept.take(message)
            except OSError as error:
                self.failure = error
                self._cancel()


async def collect(
    choice: RobotChoice, task: BabbleArmTask | BabbleWheelsTask, wanted: int, file: Path, as_json: bool
) -> int:
    """Babbles until the file holds `wanted` samples or trials; returns the exit code. Ctrl-C stops the robot.

    Raises ConfigError or RefusedError for a file that cannot be continued, CocoroError for one that cannot be written.
    """
    async with joined(choice) as link:
        robot = await description(link)
        height_m = await _standing_height(link, task.target) if task.target else None
        with collector(task.samples, file, robot, height_m) as kept:
            shown = BabbleDisplay(task_display(as_json), kept, wanted)
            if len(kept) >= wanted:
                shown.result(f"{file} holds {len(kept)} already, which is enough")
                return 0
            if len(kept):
                shown.say(f"continuing {file}: {kept.summary}")
            samples: Any = link.inbox(task.samples)  # before the request, so that no sample is missed
            task = replace(task, first=kept.next, count=wanted - len(kept))
            follower = Follower(link, TaskRequest(task=task), shown, None)
            writer = SampleWriter(kept, follower.cancel)
            samples.add(lambda _key, message: writer.take(message))
            with hands_on(follower):
                code, result = await follower.run()
            if writer.failure is not None:
                raise CocoroError(
                    f"samples {file}: {writer.failure.strerror}, so babbling was cancelled; make room there, and the "
                    f"same command continues with the {len(kept)} samples that it has"
                )
            result |= {"file": str(file), "samples": len(kept)}
    if as_json:
        print_json(result)
    return code


async def _standing_height(link: MeshLink, label: str) -> float | None:
    """Height of the centre of a known object that stands on the floor, m; None for an unknown one."""
    reply = await link.call(OBJECTS, ObjectsRequest())
    return next((known.size_m[2] / 2 for known in reply.objects if known.label == label), None)


async def description(link: MeshLink) -> Robot:
    """The description that the planner of a running robot computes with."""
    reply = await link.call(ABOUT.of("planning"), AboutRequest())
    if reply.description is None:
        raise MeshError(f"{link.robot}: the planner does not report a robot description; see `cocoro status`")
    return Robot.from_data(reply.description, f"description of {link.robot}")


def _time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
