"""The project's own topics and requests: the messages on the mesh, with their rates, ages and quality of service.

What exists on a robot is the union of these rows and those of installed third parties (`cocoro.installed`). To add a
message: a class in `cocoro/messages/`, a row here, and the row's name in the declarations of the components that
publish and read it (`services/<name>/component.py`).

A key is `<robot>/<service>/<topic>`. Rows with `{service}` in their name stand for one topic per service.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, TypeVar

import msgspec

from cocoro import messages as m
from cocoro.bus.base import Qos

M = TypeVar("M", bound=m.Message)
Q = TypeVar("Q", bound=msgspec.Struct)
R = TypeVar("R", bound=msgspec.Struct)

Right = Literal["see", "stop", "operate"]
"""What a request asks for, hence who may send it where access is restricted: everybody sees and stops, operators
operate."""

ANY = "*"
"""Stands for every service where a service's name is expected."""
_PER_SERVICE = "{service}"


SLOW_HZ = 5.0
"""Rate of topics, at most, whose newest message can be asked for (`Participant.newest`); some others' can be, too."""


@dataclass(frozen=True)
class Topic(Generic[M]):
    """A kind of message that is published, under one key of each robot."""

    name: str
    """Its key without the robot's name: `<service>/<topic>`."""
    type: type[M]
    qos: Qos
    rate_hz: float | None
    """Nominal rate; None when it is published on change."""
    max_age_s: float
    """A reader must not act on an older sample; `doc` says what it does instead."""
    doc: str
    publisher: str = ""
    """The service that publishes it. Derived from the name, except for a command: that lies under whom it commands."""
    recorded: bool = True
    """Recorders leave it out when this is False."""
    max_bytes: int = 65_536
    """A larger payload is rejected unread."""
    shown: bool = False
    """Its newest message can be asked for though it is fast: `cocoro status` shows it."""
    local: bool = False
    """It stays on its host: no gateway passes it on."""

    @property
    def slow(self) -> bool:
        """Whether who joins would have to wait for the next message."""
        return self.rate_hz is not None and self.rate_hz <= SLOW_HZ

    @property
    def askable(self) -> bool:
        """Whether its newest message can be asked for."""
        return self.slow or self.shown

    def __post_init__(self) -> None:
        if not self.publisher:
            object.__setattr__(self, "publisher", self.service)

    @property
    def service(self) -> str:
        """The service under which it lies; `ANY` for a per-service row."""
        return _service_of(self.name)

    @property
    def per_service(self) -> bool:
        return self.service == ANY

    def of(self, service: str) -> Topic[M]:
        """A per-service row's topic of one service, or with `ANY` of all."""
        return replace(self, name=self.name.format(service=service), publisher=service)

    def key(self, robot: str) -> str:
        return f"{robot}/{self.name}"


@dataclass(frozen=True)
class Request(Generic[Q, R]):
    """A question to a service, with a typed answer."""

    name: str
    """Its key without the robot's name: `<service>/<request>`."""
    request: type[Q]
    reply: type[R]
    doc: str
    timeout_s: float = 2.0
    right: Right = "operate"
    recorded: bool = True
    """Questions and answers are published for recorders, unless this is False."""
    qos: Qos = Qos.COMMAND
    """Of question and answer."""
    most_hz: float = 40.0
    """How often a person's link to a site may ask it; what follows the last one sooner gets no answer."""

    @property
    def server(self) -> str:
        """The service that answers it; `ANY` for a per-service row."""
        return _service_of(self.name)

    @property
    def per_service(self) -> bool:
        return self.server == ANY

    def of(self, service: str) -> Request[Q, R]:
        """A per-service row's request to one service, or with `ANY` to all."""
        return replace(self, name=self.name.format(service=service))

    def key(self, robot: str) -> str:
        return f"{robot}/{self.name}"


def find_topic(name: str, rows: Iterable[Topic[Any]]) -> Topic[Any] | None:
    """The row of a topic's name (its key without the robot), per-service rows resolved; None when there is none."""
    service, _, rest = name.partition("/")
    general: Topic[Any] | None = None
    for row in rows:
        if row.name == name:
            return row
        if general is None and row.name == f"{_PER_SERVICE}/{rest}":
            general = row
    return None if general is None else general.of(service)


def _service_of(name: str) -> str:
    service = name.partition("/")[0]
    return ANY if service == _PER_SERVICE else service


FRAME = Topic(
    "kinect/frame", m.Frame, Qos.FRAME, 30.0, 0.5,
    "Colour and raw depth. Perception ignores older frames.", max_bytes=16 * 1024 * 1024, local=True,
)  # fmt: skip
BASE_STATE = Topic(
    "base/state", m.BaseState, Qos.STATE, 50.0, 0.15,
    "Odometry, bumpers, battery. The older it is the slower the planner drives; beyond its age it stops the base.",
    shown=True,
)  # fmt: skip
BASE_COMMAND = Topic(
    "base/command", m.BaseCommand, Qos.COMMAND, 50.0, 0.15,
    "Wheel speeds. Beyond its age the base sets them to zero.",
    publisher="planning",
)  # fmt: skip
ARM_STATE = Topic(
    "arm/state", m.ServoState, Qos.STATE, 50.0, 0.15,
    "Neck and arm servos. Beyond its age the planner sends no commands, and detections are not localised.",
)  # fmt: skip
ARM_COMMAND = Topic(
    "arm/command", m.ServoCommand, Qos.COMMAND, 50.0, 0.15,
    "Neck and arm goals. Beyond its age the joints hold their positions.",
    publisher="planning",
)  # fmt: skip
HAND_STATE = Topic(
    "hand/state", m.ServoState, Qos.STATE, 50.0, 0.15,
    "Wrist roll and claws. Beyond its age the planner does not begin to grasp.",
)  # fmt: skip
HAND_COMMAND = Topic(
    "hand/command", m.ServoCommand, Qos.COMMAND, 50.0, 0.15,
    "Wrist roll and claw goals. Beyond its age the hand keeps its goal, so that it does not drop what it holds.",
    publisher="planning",
)  # fmt: skip
DETECTIONS = Topic(
    "perception/detections", m.Detections, Qos.STATE, 30.0, 1.0,
    "Known objects in one frame, stamped with the time of the frame. Older ones are not used.",
)  # fmt: skip
OBSTACLES = Topic(
    "perception/obstacles", m.Obstacles, Qos.STATE, 10.0, 3.0,
    "Obstacles and free floor, from the depth image. Older ones are not entered in the map.",
    max_bytes=262_144,
)  # fmt: skip
PLAN = Topic(
    "planning/status", m.PlannerStatus, Qos.STATE, 50.0, 0.5,
    "What the planner does, and the reason. Beyond its age the running task fails.",
    shown=True,
)  # fmt: skip
FLOOR_PLAN = Topic(
    "planning/map", m.FloorPlan, Qos.STATE, 2.0, 3.0,
    "The floor as the planner knows it, and the way that it drives, for who looks on. Older ones are shown as old.",
)  # fmt: skip
HAND_SAMPLES = Topic(
    "planning/hand-samples", m.HandSample, Qos.EVENT, None, 1.0,
    "One sample of the arm's babbling: joint angles, and the position of the hand's marker at that time.",
)  # fmt: skip
WHEEL_TRIALS = Topic(
    "planning/wheel-trials", m.WheelTrial, Qos.EVENT, None, 1.0,
    "One trial of the wheels' babbling.",
)  # fmt: skip
MODEL = Topic(
    "planning/model", m.LearnedModel, Qos.EVENT, None, 1.0,
    "The learned model that the planner has accepted.", max_bytes=8 * 1024 * 1024,
)  # fmt: skip
POLICY_ACTIONS = Topic(
    "policy/actions", m.PolicyActions, Qos.STATE, None, 1.0,
    "A chunk of actions that a learned policy proposes. The planner follows it row by row, within all limits; a chunk "
    "that is used up or too old counts no more, and the robot stands.",
    max_bytes=262_144,
)  # fmt: skip
INTENT = Topic(
    "executive/intent", m.Intent, Qos.COMMAND, 50.0, 0.3,
    "The wanted behaviour. The wheels stop after `command_timeout_s`; beyond its age the planner becomes idle.",
)  # fmt: skip
TASK = Topic(
    "executive/task", m.TaskState, Qos.EVENT, 5.0, 2.0,
    "The phase and the progress of the running task, and its outcome.",
)  # fmt: skip
LATCH = Topic(
    "executive/latch", m.Latch, Qos.STATE, 5.0, 2.0,
    "The state of the emergency stop, for hardware services that have just started.",
)  # fmt: skip
CLOCK = Topic(
    "sim/clock", m.ClockTick, Qos.COMMAND, 120.0, 1.0,
    "Simulated time. Time stands still without it.",
)  # fmt: skip
TRUTH = Topic(
    "sim/truth", m.Truth, Qos.STATE, 30.0, 1.0,
    "The true poses: only for tests, the judge and viewers.",
)  # fmt: skip
HEALTH = Topic(
    "{service}/health", m.Health, Qos.STATE, 1.0, 3.0,
    "Rates, ages, losses, loops, CPU time and memory of a service.",
)  # fmt: skip
STEPS = Topic(
    "{service}/steps", m.StepRecord, Qos.EVENT, None, 1.0,
    "The inputs and outputs of each step of a pure core, when recording of steps is on.",
)  # fmt: skip
EXCHANGES = Topic(
    "{service}/requests", m.Exchange, Qos.EVENT, None, 1.0,
    "Every request to a service, with its answer, for recorders.", max_bytes=4 * 1024 * 1024,
)  # fmt: skip
OFFSET = Topic(
    "{service}/offset", m.ClockOffset, Qos.STATE, 1.0, 3.0,
    "How far a host's clock is off that of the host that keeps its robot's time, from the host's gateway.",
)  # fmt: skip
RECORDING = Topic(
    "{service}/recording", m.Recording, Qos.STATE, 1.0, 3.0,
    "The state of a recorder: its file, what it dropped, why it stopped.",
)  # fmt: skip

TOPICS: tuple[Topic[Any], ...] = (
    FRAME, BASE_STATE, BASE_COMMAND, ARM_STATE, ARM_COMMAND, HAND_STATE, HAND_COMMAND,
    DETECTIONS, OBSTACLES, PLAN, FLOOR_PLAN, HAND_SAMPLES, WHEEL_TRIALS, MODEL, POLICY_ACTIONS, INTENT, TASK,
    LATCH, CLOCK, TRUTH, HEALTH, STEPS, EXCHANGES, OFFSET, RECORDING,
)  # fmt: skip

RUN = Request(
    "executive/run", m.TaskRequest, m.TaskReply,
    "Start a task; refused, with the reason, when that is not possible.",
)  # fmt: skip
CANCEL = Request(
    "executive/cancel", m.CancelRequest, m.TaskReply,
    "End the running task; the robot stops.",
)  # fmt: skip
DRIVE = Request(
    "executive/drive", m.DriveRequest, m.DriveReply,
    "One input of an operator who drives by hand; it moves the robot for at most 0.2 s.",
    timeout_s=0.5, most_hz=100.0,
)  # fmt: skip
REPORT = Request(
    "executive/report", m.ReportRequest, m.TaskState,
    "The state of a task, running or ended; one without an id for a task that is not known.",
    right="see",
)  # fmt: skip
OBJECTS = Request(
    "executive/objects", m.ObjectsRequest, m.ObjectsReply,
    "The known objects, and where each was seen last.",
    right="see",
)  # fmt: skip
TASKS = Request(
    "executive/tasks", m.TasksRequest, m.TasksReply,
    "The tasks that can be asked for, each with its options.",
    right="see",
)  # fmt: skip
ESTOP = Request(
    "{service}/estop", m.EstopRequest, m.EstopReply,
    "Latch the emergency stop; answered by each service that moves something, and by the executive.",
    timeout_s=1.0, right="stop", most_hz=200.0,
)  # fmt: skip
RESET = Request(
    "{service}/reset", m.ResetRequest, m.EstopReply,
    "Release the emergency stop; answered by the same services. A key of its own, since everybody may stop a robot.",
    timeout_s=1.0,
)  # fmt: skip

LEARNED = Request(
    "planning/learned", m.ModelRequest, m.ModelReply,
    "Use a learned model; refused, with the reason, when it is damaged, of another robot or of another version.",
)  # fmt: skip
RECOVER = Request(
    "base/recover", m.RecoverRequest, m.RecoverReply,
    "Put a Create that has left its mode back into it, or clear the faults of wheels with servos; by the real base.",
    timeout_s=3.0,
)  # fmt: skip
SERVOS = Request(
    "{service}/servos", m.ServoRequest, m.ServoReply,
    "Clear faults, relax or hold joints; answered by each group of real servos.",
    timeout_s=3.0,
)  # fmt: skip
PACKED = Request(
    "packer/frame", m.PackedRequest, m.PackedFrame,
    "The newest frame, packed for a network, since frames themselves stay on their host.",
    timeout_s=1.0, right="see", qos=Qos.FRAME, recorded=False,
)  # fmt: skip
ABOUT = Request(
    "{service}/about", m.AboutRequest, m.AboutReply,
    "The component, settings and versions of a service; answered by every service.",
    right="see",
)  # fmt: skip
TIME = Request(
    "{service}/time", m.TimeRequest, m.TimeReply,
    "The robot's time on a host, from its gateway; hosts and persons compare their clocks by it.",
    timeout_s=1.0, right="see", recorded=False, most_hz=1000.0,
)  # fmt: skip

STOPS: tuple[Request[Any, Any], ...] = (ESTOP, RESET)
"""What each service that moves something serves."""

REQUESTS: tuple[Request[Any, Any], ...] = (
    RUN, CANCEL, DRIVE, REPORT, OBJECTS, TASKS, *STOPS, LEARNED, RECOVER, SERVOS, PACKED, ABOUT, TIME,
)  # fmt: skip
