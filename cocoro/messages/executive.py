"""Requests and progress of tasks, and the known objects."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from cocoro.messages.common import Finite, FiniteVec3, Message
from cocoro.messages.planning import TargetEstimate

Outcome = Literal["done", "failed", "cancelled"]


class Phase(msgspec.Struct, kw_only=True):
    name: str
    start_ns: int
    end_ns: int | None = None


class TaskState(Message):
    """State of the running task, or of the last one when none runs."""

    task_id: str = ""
    task: str = ""
    label: str = ""
    phase: str = "idle"
    text: str = ""
    """The planner's reason for what the robot does now, for people."""
    distance_m: Finite | None = None
    started_ns: int = 0
    phases: tuple[Phase, ...] = ()
    outcome: Outcome | None = None
    reason: str = ""
    """For failed and cancelled tasks, and where it needs one for a task that is done: a word (not_found, lost, slipped,
    unreachable, timed_out, ...), a colon, and a sentence."""
    elapsed_s: Finite = 0.0
    measures: dict[str, Finite] = {}
    """The task's own figures on how well it goes, by name; which ones is said where the task is described."""


class TaskRequest(msgspec.Struct, kw_only=True):
    task: Any
    """A `cocoro.tasks.Task`. On the wire, and where it was received: a map with the task's name in `task`, and its
    fields."""
    timeout_s: Annotated[float, Meta(gt=0, le=3600)] | None = None
    """None: the task's own limit."""
    asker: str = ""
    """When the liveliness token `<robot>/<asker>/asker` is gone, the task is cancelled. Empty: nobody is watched."""
    instead: bool = False
    """Cancel the running task, wait until the robot is at rest, then start this one. Without, it is refused as busy."""


RefusalCode = Literal[
    "unknown_label", "not_graspable", "busy", "estop", "not_alive", "battery", "holding", "not_holding", "bad_request",
    "no_task", "asker_gone", "not_able",
]  # fmt: skip


class TaskReply(msgspec.Struct, kw_only=True):
    """The accepted task's id, or a refusal with a code and a sentence that says what to do."""

    accepted: bool
    task_id: str = ""
    refusal: RefusalCode | None = None
    text: str = ""


class CancelRequest(msgspec.Struct, kw_only=True):
    task_id: str = ""
    """Empty: cancel the running task, whichever it is."""


class ReportRequest(msgspec.Struct, kw_only=True):
    task_id: str = ""
    """Empty: the running task, or the last one."""


class ObjectsRequest(msgspec.Struct, kw_only=True):
    pass


class KnownObject(msgspec.Struct, kw_only=True):
    label: str
    shape: Literal["cylinder", "sphere", "box"]
    size_m: FiniteVec3
    graspable: bool
    seen: TargetEstimate | None = None


class ObjectsReply(msgspec.Struct, kw_only=True):
    objects: tuple[KnownObject, ...]


OptionType = Literal["bool", "int", "float", "str"]


class TaskOption(msgspec.Struct, kw_only=True):
    """A parameter of a task beside its label."""

    name: str
    type: OptionType
    default: Any = None
    needed: bool = False
    """It has no default."""
    description: str = ""
    min: Finite | None = None
    max: Finite | None = None


class TaskKind(msgspec.Struct, kw_only=True):
    """A task that the executive can run."""

    name: str
    doc: str = ""
    """One paragraph."""
    label: Literal["", "known", "graspable"] = ""
    """Which objects its label may name; '' for a task without one."""
    label_needed: bool = False
    samples: bool = False
    """It reports samples for learning, which somebody has to keep."""
    options: tuple[TaskOption, ...] = ()


class TasksRequest(msgspec.Struct, kw_only=True):
    pass


class TasksReply(msgspec.Struct, kw_only=True):
    tasks: tuple[TaskKind, ...]
