"""What travels on the mesh: one table. Recorder, health, access control and the documentation are derived
from it; adding a message type means a class in `cocoro/messages/` and a row here.

A key is `<robot>/<service>/<topic>`. Rows with `{service}` in their name stand for one topic per service.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import msgspec

from cocoro import messages as m
from cocoro.bus.base import Qos

M = TypeVar("M", bound=m.Message)
Q = TypeVar("Q", bound=msgspec.Struct)
R = TypeVar("R", bound=msgspec.Struct)


@dataclass(frozen=True)
class Topic(Generic[M]):
    name: str
    type: type[M]
    qos: Qos
    publisher: str
    """The service that publishes it ('*' for the per-service rows, 'sim' for the simulator's own)."""
    rate_hz: float | None
    """Nominal; None when it is published on change."""
    max_age_s: float
    """A reader must not act on a sample older than this; the row's doc says what it does instead."""
    doc: str
    recorded: bool = True
    max_bytes: int = 65_536
    """A larger payload is rejected unread."""

    def of(self, service: str) -> Topic[M]:
        """The row for one service, where the row is a per-service one."""
        from dataclasses import replace

        return replace(self, name=self.name.format(service=service), publisher=service)

    def key(self, robot: str) -> str:
        return f"{robot}/{self.name}"


@dataclass(frozen=True)
class Request(Generic[Q, R]):
    """A question with a typed answer."""

    name: str
    request: type[Q]
    reply: type[R]
    server: str
    doc: str
    timeout_s: float = 2.0

    def of(self, service: str) -> Request[Q, R]:
        from dataclasses import replace

        return replace(self, name=self.name.format(service=service), server=service)

    def key(self, robot: str) -> str:
        return f"{robot}/{self.name}"


FRAME = Topic(
    "kinect/frame", m.Frame, Qos.FRAME, "kinect", 30.0, 0.5,
    "Colour and raw depth. Older frames are not looked at.", max_bytes=16 * 1024 * 1024,
)  # fmt: skip
BASE_STATE = Topic(
    "base/state", m.BaseState, Qos.STATE, "base", 50.0, 0.15,
    "Odometry, bumpers, battery. Beyond its age the planner stops the base; until then it drives the slower.",
)  # fmt: skip
BASE_COMMAND = Topic(
    "base/command", m.BaseCommand, Qos.COMMAND, "planning", 50.0, 0.15,
    "Wheel speeds. Beyond its age the base commands zero.",
)  # fmt: skip
ARM_STATE = Topic(
    "arm/state", m.ServoState, Qos.STATE, "arm", 50.0, 0.15,
    "Neck and arm servos. Beyond its age the planner commands nothing and detections stay unlocalised.",
)  # fmt: skip
ARM_COMMAND = Topic(
    "arm/command", m.ServoCommand, Qos.COMMAND, "planning", 50.0, 0.15,
    "Neck and arm goals. Beyond its age the joints hold where they are.",
)  # fmt: skip
HAND_STATE = Topic(
    "hand/state", m.ServoState, Qos.STATE, "hand", 50.0, 0.15,
    "Wrist roll and claws. Beyond its age the planner does not start to grasp.",
)  # fmt: skip
HAND_COMMAND = Topic(
    "hand/command", m.ServoCommand, Qos.COMMAND, "planning", 50.0, 0.15,
    "Wrist roll and claw goals. Beyond its age the hand keeps its goal: what is held stays held.",
)  # fmt: skip
DETECTIONS = Topic(
    "perception/detections", m.Detections, Qos.STATE, "perception", 30.0, 1.0,
    "Known objects in one frame, stamped with the frame's time. Older ones only age the target memory.",
)  # fmt: skip
OBSTACLES = Topic(
    "perception/obstacles", m.Obstacles, Qos.STATE, "perception", 10.0, 1.0,
    "What stands on the floor and where it is free, from the depth image. Older ones are not entered in the map.",
    max_bytes=262_144,
)  # fmt: skip
PLAN = Topic(
    "planning/status", m.PlannerStatus, Qos.STATE, "planning", 50.0, 0.5,
    "What the planner does and why. Beyond its age the running task fails: planner silent.",
)  # fmt: skip
HAND_SAMPLES = Topic(
    "planning/hand-samples", m.HandSample, Qos.EVENT, "planning", None, 1.0,
    "What the arm's babbling saw: joint angles and the hand's marker at one time.",
)  # fmt: skip
WHEEL_TRIALS = Topic(
    "planning/wheel-trials", m.WheelTrial, Qos.EVENT, "planning", None, 1.0,
    "What each trial of the wheels' babbling saw.",
)  # fmt: skip
MODEL = Topic(
    "planning/model", m.LearnedModel, Qos.EVENT, "planning", None, 1.0,
    "The learned model that the planner has taken over.", max_bytes=8 * 1024 * 1024,
)  # fmt: skip
INTENT = Topic(
    "executive/intent", m.Intent, Qos.COMMAND, "executive", 50.0, 0.3,
    "The behaviour that is wanted. The wheels stand when it is 0.15 s old; beyond its age the planner goes idle.",
)  # fmt: skip
TASK = Topic(
    "executive/task", m.TaskState, Qos.EVENT, "executive", 5.0, 2.0,
    "The running task's phase and progress, and its outcome.",
)  # fmt: skip
LATCH = Topic(
    "executive/latch", m.Latch, Qos.STATE, "executive", 5.0, 2.0,
    "The emergency stop's state, for hardware services that have just started.",
)  # fmt: skip
CLOCK = Topic(
    "sim/clock", m.ClockTick, Qos.COMMAND, "sim", 120.0, 1.0,
    "Simulated time. When it stands, time stands.",
)  # fmt: skip
TRUTH = Topic(
    "sim/truth", m.Truth, Qos.STATE, "sim", 30.0, 1.0,
    "Where everything really is: for tests, the judge and viewers alone.",
)  # fmt: skip
HEALTH = Topic(
    "{service}/health", m.Health, Qos.STATE, "*", 1.0, 3.0,
    "A service's rates, ages, losses, loops, CPU and memory.",
)  # fmt: skip
STEPS = Topic(
    "{service}/steps", m.StepRecord, Qos.EVENT, "*", None, 1.0,
    "What each step of a pure core consumed and gave (when recording of steps is on).",
)  # fmt: skip

EXCHANGES = Topic(
    "{service}/requests", m.Exchange, Qos.EVENT, "*", None, 1.0,
    "Every request that a service was asked, with its answer: for the record.", max_bytes=4 * 1024 * 1024,
)  # fmt: skip
RECORDING = Topic(
    "{service}/recording", m.Recording, Qos.STATE, "*", 1.0, 3.0,
    "How a recorder is getting on: its file, what it dropped, why it stopped.",
)  # fmt: skip

TOPICS: tuple[Topic[Any], ...] = (
    FRAME, BASE_STATE, BASE_COMMAND, ARM_STATE, ARM_COMMAND, HAND_STATE, HAND_COMMAND,
    DETECTIONS, OBSTACLES, PLAN, HAND_SAMPLES, WHEEL_TRIALS, MODEL, INTENT, TASK, LATCH, CLOCK, TRUTH,
    HEALTH, STEPS, EXCHANGES, RECORDING,
)  # fmt: skip

RUN = Request(
    "executive/run", m.TaskRequest, m.TaskReply, "executive",
    "Start a task; refused with a reason when it cannot be.",
)  # fmt: skip
CANCEL = Request(
    "executive/cancel", m.CancelRequest, m.TaskReply, "executive",
    "End the running task; the robot stands still.",
)  # fmt: skip
OBJECTS = Request(
    "executive/objects", m.ObjectsRequest, m.ObjectsReply, "executive",
    "The known objects and where each was seen last.",
)  # fmt: skip
ESTOP = Request(
    "{service}/estop", m.EstopRequest, m.EstopReply, "*",
    "Latch or release the emergency stop; answered by every hardware service and the executive.",
    timeout_s=1.0,
)  # fmt: skip

LEARNED = Request(
    "planning/learned", m.ModelRequest, m.ModelReply, "planning",
    "Take over a learned model; refused, with the reason, when it is damaged, foreign or of another version.",
)  # fmt: skip
RECOVER = Request(
    "base/recover", m.RecoverRequest, m.RecoverReply, "base",
    "Put a Create that left its mode back into it; answered by the real base.",
    timeout_s=3.0,
)  # fmt: skip
SERVOS = Request(
    "{service}/servos", m.ServoRequest, m.ServoReply, "*",
    "Clear faults, relax or hold joints; answered by each real servo network.",
    timeout_s=3.0,
)  # fmt: skip
ABOUT = Request(
    "{service}/about", m.AboutRequest, m.AboutReply, "*",
    "What a service is and what it was started with: answered by every service.",
)  # fmt: skip

REQUESTS: tuple[Request[Any, Any], ...] = (RUN, CANCEL, OBJECTS, ESTOP, LEARNED, RECOVER, SERVOS, ABOUT)

HARDWARE = ("kinect", "base", "arm", "hand")
"""The services whose keys the simulator impersonates."""
STOPPABLE = ("base", "arm", "hand")
"""The hardware services that move something, and so answer the emergency stop."""


def topic_named(name: str) -> Topic[Any] | None:
    """The row for a topic's name (key without the robot), per-service rows resolved; None when unknown."""
    for topic in TOPICS:
        if topic.name == name:
            return topic
    service, _, rest = name.partition("/")
    for topic in TOPICS:
        if topic.name == f"{{service}}/{rest}":
            return topic.of(service)
    return None
