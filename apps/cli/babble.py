"""`cocoro babble`: have the robot babble, and keep what it reports in a file that the next time goes on from."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from apps.cli.interrupt import on_interrupt
from apps.cli.link import Link, joined
from apps.cli.options import RobotChoice
from apps.cli.output import going_on
from apps.cli.progress import TaskDisplay, task_display
from apps.cli.tasks import Follower
from apps.learning.collector import SampleCollector, collector
from cocoro.errors import CocoroError, MeshError
from cocoro.messages import AboutRequest, Message, ObjectsRequest, TaskRequest, TaskState
from cocoro.robot import Robot
from cocoro.topics import ABOUT, OBJECTS
from services.executive.tasks import BabbleArmTask, BabbleWheelsTask

BAR = 20
"""Characters of the progress bar."""


class BabbleDisplay:
    """Shows the samples beside what the task says: a bar, the coverage, and the time that is left at this rate."""

    def __init__(self, view: TaskDisplay, kept: SampleCollector[Any], wanted: int) -> None:
        self._view = view
        self._kept = kept
        self._wanted = wanted
        self._had = len(kept)

    def show(self, state: TaskState) -> None:
        if state.phase.startswith("babble"):
            state.text = self.text(state.elapsed_s)
        self._view.show(state)

    def say(self, text: str) -> None:
        self._view.say(text)

    def result(self, text: str) -> None:
        self._view.result(f"{text}; {self._kept.said}")

    def close(self) -> None:
        self._view.close()

    def text(self, elapsed_s: float) -> str:
        count = len(self._kept)
        full = round(BAR * min(count / self._wanted, 1.0))
        new = count - self._had
        left = f", {_time((self._wanted - count) * elapsed_s / new)} left" if new else ""
        return f"[{'#' * full}{'.' * (BAR - full)}] {count} of {self._wanted}: {self._kept.said}{left}"


class SampleWriter:
    """Keeps what is reported. When the file takes no more, it cancels: the robot need not move for nothing."""

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


async def babble(
    where: RobotChoice, task: BabbleArmTask | BabbleWheelsTask, wanted: int, file: Path, as_json: bool
) -> int:
    """Babble until the file holds `wanted` samples or trials. Ctrl-C stops the robot and keeps them. Returns the exit
    code; raises ConfigError or RefusedError for a file that cannot be continued."""
    async with joined(where) as link:
        robot = await description(link)
        height_m = await _standing_height(link, task.target) if task.target else None
        with collector(task.samples, file, robot, height_m) as kept:
            shown = BabbleDisplay(task_display(as_json), kept, wanted)
            if len(kept) >= wanted:
                shown.result(f"{file} holds enough already")
                return 0
            if len(kept):
                shown.say(f"going on from {file}: {kept.said}")
            samples: Any = link.inbox(task.samples)  # before the task is asked for, so that nothing is missed
            task = replace(task, first=kept.next, count=wanted - len(kept))
            follower = Follower(link, TaskRequest(task=task), shown, None)
            keeper = SampleWriter(kept, follower.cancel)
            samples.add(lambda _key, message: keeper.take(message))
            with on_interrupt(follower.interrupt), going_on():
                code, result = await follower.run()
            if keeper.failure is not None:
                raise CocoroError(
                    f"samples {file}: {keeper.failure.strerror}, so babbling was cancelled; make room there, and the "
                    f"same command goes on with the {len(kept)} that it has"
                )
            result |= {"file": str(file), "samples": len(kept)}
    if as_json:
        print(json.dumps(result))
    return code


async def _standing_height(link: Link, label: str) -> float | None:
    """Height of the centre of a known object that stands on the floor, m; None for an unknown one."""
    reply = await link.call(OBJECTS, ObjectsRequest())
    return next((known.size_m[2] / 2 for known in reply.objects if known.label == label), None)


async def description(link: Link) -> Robot:
    """The description that the planner of a running robot computes with."""
    reply = await link.call(ABOUT.of("planning"), AboutRequest())
    if reply.description is None:
        raise MeshError(f"{link.robot}: the planner does not say what robot it is")
    return Robot.from_data(reply.description, f"description of {link.robot}")


def _time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
