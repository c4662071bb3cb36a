"""A task as a type: its parameters, what it needs, its time limit, and the routine that carries it out.

    class NodTask(Task, frozen=True, kw_only=True, tag="nod"):
        \"\"\"Nod the head.\"\"\"

        times: Annotated[int, Meta(ge=1, le=10, description="How often.")] = 2

        async def run(self, skills: Skills) -> None:
            await skills.do(Nod(self.times), timeout_s=20.0)

Its tag is its name on the wire and on the command line. Executive, command line and rehearsals take everything else
from the type. The project's own tasks are listed in `services.executive.tasks`; a third party adds one by an entry
point of the group `cocoro.tasks` that points to the type (docs/tasks.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, ClassVar, Literal, Protocol

import msgspec

from cocoro.entry_points import added_to
from cocoro.messages import PlannerStatus
from cocoro.messages.actions import TASK_GROUP, Action
from cocoro.tagged import Registry, Tagged
from cocoro.topics import Topic
from cocoro.units import Positive, Vec2, Vec3

BodyPart = Literal["marker", "neck"]
"""Parts of a body that not every robot has."""

UNLIMITED_S = 86_400.0
"""Time limit of a task that has no end of its own."""


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Time limits and tries of the routines; a profile's `[service.executive]` table sets them."""

    task_timeout_s: Positive = 240.0
    search_timeout_s: Positive = 130.0
    """A whole search, from all the places that it looks from."""
    approach_timeout_s: Positive = 60.0
    carry_timeout_s: Positive = 90.0
    reach_timeout_s: Positive = 20.0
    grasp_timeout_s: Positive = 6.0
    lift_timeout_s: Positive = 15.0
    place_timeout_s: Positive = 25.0
    babble_timeout_s: Positive = UNLIMITED_S
    park_timeout_s: Positive = 20.0
    hold_s: Positive = 2.3
    """How long a lifted thing must stay held before a fetch is done."""
    relocate_tries: int = 3
    """How often a target may be lost or out of reach and be approached again."""
    grasp_tries: int = 2
    """A second try after a slip."""


class TaskFailedError(Exception):
    """A step, and with it perhaps the task, failed: `reason` is a word to decide on, `text` is for people."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(f"{reason}: {text}" if text else reason)
        self.reason = reason
        self.text = text


class Skills(Protocol):
    """The steps that a routine is made of. Each raises TaskFailedError with the planner's reason, or with `not_alive`
    when the planner falls silent."""

    @property
    def limits(self) -> Limits: ...

    @property
    def status(self) -> PlannerStatus | None:
        """The planner's newest status; None when that is too old."""

    async def do(self, action: Action, *, timeout_s: float) -> PlannerStatus:
        """Have the planner carry out an action to its end. Raises TaskFailedError('timed_out') when it takes longer
        than `timeout_s`."""

    async def keep_doing(self, action: Action, *, until_s: float, watch: Callable[[PlannerStatus], None] = ...) -> None:
        """Have the planner carry out an action that has no end, until a time (`now_s`). `watch` gets its statuses."""

    def since_input_s(self) -> float:
        """Time since an operator's motion counted last (action `drive`), or since the task began."""

    def measure(self, name: str, value: float) -> None:
        """Set one of the task's `measures`, which its state tells."""

    async def watch_hold(self, seconds: float) -> None:
        """Hold still for a time; raises TaskFailedError('slipped') when the hand loses what it holds."""

    def place(self) -> Vec2:
        """The position of the body, odometry frame, m."""

    def size_m(self, label: str) -> Vec3:
        """Extents of a known object: over the floor, over the floor, height. Raises KeyError for an unknown one."""

    def now_s(self) -> float:
        """The robot's clock, s."""


class Task(Tagged, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="task"):
    """Base class of all tasks; see the module's docstring.

    Fields are the task's parameters. Their `Meta` gives limits and, as `description`, the command line's help; a field
    `label` is the command's argument, every other one an option that is named without its unit (`distance_m` is
    `--distance`). `Meta(extra={"option": False})` keeps a field off the command line.
    """

    needs_label: ClassVar[Literal["", "known", "graspable"]] = ""
    """Whether the object that `label` names must be known, or known and graspable."""
    hand: ClassVar[Literal["empty", "holding", "any"]] = "empty"
    """State of the hand in which the task may start."""
    needs_body: ClassVar[tuple[BodyPart, ...]] = ()
    """Parts that not every robot has and that the task cannot do without."""
    needs_battery: ClassVar[bool] = True
    """False: the task may start with a low battery."""
    snapshot_phase: ClassVar[str] = ""
    """The phase at whose end the command line's `--snapshot` takes its picture; '' gives no such option."""
    pursuit_phase: ClassVar[str] = ""
    """The phase in which the robot keeps behind a moving object; rehearsals judge it. '' for none."""
    services: ClassVar[tuple[str, ...]] = ()
    """Services that it needs beside those that every task needs."""
    samples: ClassVar[Topic[Any] | None] = None
    """The topic on which it reports samples for learning. Such a task has the fields `first` (number to go on with)
    and `count`."""
    brings: ClassVar[tuple[type[Action], ...]] = ()
    """Actions of its own, which a third party's task may have."""

    def limit_s(self, limits: Limits) -> float:
        """Time limit of the whole task where its request has none."""
        return limits.task_timeout_s

    async def run(self, skills: Skills) -> str | None:
        """The routine. Raises TaskFailedError when the task fails. May return why it is done, as `TaskState.reason`."""
        raise NotImplementedError


def registry(own: Iterable[type[Task]]) -> Registry[Task]:
    """All tasks by name: the given ones, and those of third parties."""
    return Registry("task", own, _third_parties)


def _third_parties() -> Iterator[type[Task]]:
    for _, value, _ in added_to(TASK_GROUP).added:
        if isinstance(value, type) and issubclass(value, Task):
            yield value
