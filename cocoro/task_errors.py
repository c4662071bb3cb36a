"""What a client of tasks raises: why a robot refused a task, and how one ended that did not end as done.

Refusals have a class for each code of `cocoro.messages.RefusalCode`, so that a program can decide on one:

    try:
        await robot.fetch("red_can")
    except cocoro.HoldingError:
        await robot.put_down()
    except cocoro.TaskFailedError as failed:
        print(failed.reason, failed.text)
"""

from __future__ import annotations

from cocoro.errors import CocoroError, RefusedError
from cocoro.messages import RefusalCode, TaskReply, TaskState
from cocoro.tasks import TaskFailedError


class TaskRefusedError(RefusedError):
    """The robot does not start the task, or does not cancel one. The text is the robot's: what is wrong, and what to
    do."""

    def __init__(self, text: str, code: RefusalCode | None = None) -> None:
        super().__init__(text)
        self.code = code
        """The refusal as the robot sent it; None when it sent none."""


class UnknownLabelError(TaskRefusedError):
    """The robot knows no object of that label; the text lists those that it knows."""


class NotGraspableError(TaskRefusedError):
    """The object does not fit into the hand."""


class BusyError(TaskRefusedError):
    """Another task runs."""


class StoppedError(TaskRefusedError):
    """The emergency stop is latched, or it is not known whether it is."""


class NotAliveError(TaskRefusedError):
    """A service that the task needs is dead, is not heard, or cannot read its input."""


class BatteryLowError(TaskRefusedError):
    """The battery is too low for a task that drives."""


class HoldingError(TaskRefusedError):
    """The hand holds something."""


class NotHoldingError(TaskRefusedError):
    """The hand holds nothing."""


class BadRequestError(TaskRefusedError):
    """There is no task of that name, or one of its fields has a wrong value."""


class NoTaskError(TaskRefusedError):
    """The task that was to be cancelled or attended does not run, or is not known."""


class AskerGoneError(TaskRefusedError):
    """The robot does not see the client that asked: the two lost contact meanwhile."""


class NotAbleError(TaskRefusedError):
    """The robot's body lacks a part that the task needs."""


REFUSALS: dict[RefusalCode, type[TaskRefusedError]] = {
    "unknown_label": UnknownLabelError,
    "not_graspable": NotGraspableError,
    "busy": BusyError,
    "estop": StoppedError,
    "not_alive": NotAliveError,
    "battery": BatteryLowError,
    "holding": HoldingError,
    "not_holding": NotHoldingError,
    "bad_request": BadRequestError,
    "no_task": NoTaskError,
    "asker_gone": AskerGoneError,
    "not_able": NotAbleError,
}


def refusal(reply: TaskReply) -> TaskRefusedError:
    """The error of a reply that does not accept."""
    code = reply.refusal
    kind = TaskRefusedError if code is None else REFUSALS.get(code, TaskRefusedError)
    return kind(reply.text, code)


class TaskEndedError(TaskFailedError, CocoroError):
    """The task ended and is not done. `reason` is a word to decide on, `text` a sentence for people."""

    def __init__(self, state: TaskState, reason: str, text: str) -> None:
        super().__init__(reason, text)
        self.state = state
        """The task's last state that is known."""

    def __str__(self) -> str:
        name = f"{self.state.task} {self.state.label}".strip()
        return f"{name}: {super().__str__()}"


class TaskCancelledError(TaskEndedError):
    """Somebody cancelled the task, or its client was gone."""


class TaskLostError(TaskEndedError):
    """The outcome of the task is not known: the contact with the robot was lost. `reason` is 'lost_contact', or 'died'
    when the task has ended with the executive."""


def ending(state: TaskState) -> TaskEndedError:
    """The error of a last state whose outcome is not 'done'."""
    word, colon, text = state.reason.partition(": ")
    if state.outcome != "cancelled":
        return TaskEndedError(state, word, text)
    return TaskCancelledError(state, word if colon else "cancelled", text or state.reason)
