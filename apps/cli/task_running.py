"""Runs tasks for the command line: asks for one, waits for another's, cancels."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from apps.cli import exits
from apps.cli.interrupt import HANDS_OFF, SIGNALS, on_reader_gone, on_signals
from apps.cli.link import MeshLink, joined
from apps.cli.options import RobotChoice
from apps.cli.output import complain, going_on, print_json, tell
from apps.cli.progress import task_display
from apps.cli.snapshot import check
from apps.cli.tasks import Follower
from cocoro.errors import CocoroError
from cocoro.messages import CancelRequest, ReportRequest, TaskRequest
from cocoro.topics import CANCEL, REPORT
from deploy.contact import ProcessContact, SleepDetector


async def run(choice: RobotChoice, request: TaskRequest, as_json: bool, picture: Path | None) -> int:
    """Runs a task to its outcome and returns the exit code. `picture`: file for the last picture of the task's snapshot
    phase.

    Raises MeshError when the robot or its executive is not there, ConfigError for a name that is not a PNG file's.
    """
    if picture is not None:
        check(picture)
    async with joined(choice, frames=picture is not None) as link:
        follower = Follower(
            link, request, task_display(as_json), picture, _contact(link), rejoin=lambda: joined(choice)
        )
        with hands_on(follower):
            code, result = await follower.run()
    if as_json:
        print_json(result)
    return code


async def detach(choice: RobotChoice, request: TaskRequest, as_json: bool) -> int:
    """Asks for a task that goes on without this command, and prints its id; returns the exit code."""
    async with joined(choice) as link:
        follower = Follower(link, request, task_display(as_json), None, watched=False)
        with hands_on(follower):
            code, result = await follower.ask()
    if as_json:
        print_json(result)
    elif code == exits.DONE:
        print(result["task_id"])
    return code


async def wait(choice: RobotChoice, task_id: str, as_json: bool) -> int:
    """Follows a task that somebody else asked for (the running one, or the last, without an id) to its outcome; returns
    the exit code of that. Ctrl-C ends the waiting alone."""
    async with joined(choice) as link:
        follower = Follower(link, None, task_display(as_json), None, _contact(link), rejoin=lambda: joined(choice))
        follower.listen()  # before the question, so that no state is missed
        state = await link.call(REPORT, ReportRequest(task_id=task_id))
        if not state.task_id:
            raise CocoroError(
                f"{link.robot}: the executive knows no task {task_id}: it has restarted since, or the name is wrong"
                if task_id
                else f"{link.robot}: no task has run since the executive started"
            )
        with on_signals(SIGNALS, lambda _number: follower.leave()), going_on():
            code, result = await follower.attend(state)
    if as_json:
        print_json(result)
    return code


async def cancel(choice: RobotChoice, task_id: str = "", as_json: bool = False) -> int:
    """Cancels the running task, or that task if it runs; the exit code is 3 when it does not."""
    async with joined(choice) as link:
        reply = await link.call(CANCEL, CancelRequest(task_id=task_id))
    if not reply.accepted:
        complain(f"refused: {reply.text}")
        return exits.REFUSED
    tell(as_json, {"task_id": reply.task_id, "cancelled": True}, reply.text or "cancelled")
    return exits.DONE


def _contact(link: MeshLink) -> ProcessContact:
    return ProcessContact(link.run_dir.claimant_pid, SleepDetector())


@contextmanager
def hands_on(follower: Follower) -> Iterator[None]:
    """Cancels the follower's task when a person ends this command or lets go of it."""
    with on_signals(HANDS_OFF, follower.signalled, hurried=True), on_reader_gone(follower.cancel), going_on():
        yield
