"""What the planner is told, what it does, and what it has learned."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from cocoro.messages.actions import ACTIONS
from cocoro.messages.common import Count, Finite, FiniteVec2, FiniteVec3, Message


class Intent(Message):
    """What the executive wants of the planner. Repeated at the topic's rate: a planner that no longer hears it stands
    still."""

    action: Any
    """One of `cocoro.messages.actions`, or a third party's: a map with the action's name in `action`, and its fields.
    A message whose action is unknown or has a bad field is rejected."""
    task_id: str = ""
    step: Count = 0
    """Counts the intents of one run of the executive, so that a status can say which one it answers."""

    def __post_init__(self) -> None:
        self.action = ACTIONS.read(self.action)


class TargetEstimate(msgspec.Struct, kw_only=True):
    """What the planner believes of one object now: fused over time and carried by odometry."""

    label: str
    position_m: FiniteVec3
    """Centre, body frame, now."""
    velocity_mps: FiniteVec3 = (0.0, 0.0, 0.0)
    """In the odometry frame."""
    sigma_m: Finite = 0.0
    """Standard deviation of the horizontal position."""
    age_s: Finite = 0.0
    """Since the newest frame in which it was localised."""
    odometry_position_m: FiniteVec3 = (0.0, 0.0, 0.0)
    """The same centre in the odometry frame."""


class PlannerStatus(Message):
    """What the planner does and why; the executive decides on it, people read it."""

    task_id: str = ""
    step: Count = 0
    behaviour: str = "idle"
    """The name of the action that it carries out."""
    state: Literal["running", "done", "failed"] = "running"
    reason: str = ""
    """For 'failed', a word that the executive acts on: lost, unreachable, blocked, slipped, no_grip, stale."""
    why: str = ""
    """One sentence for people: why it does what it does now."""
    target: TargetEstimate | None = None
    distance_m: Finite | None = None
    """What is left to go: to the stopping place when driving, hand to target when reaching."""
    hand_m: FiniteVec3 | None = None
    """Centre between the pads, body frame, felt (from the joint angles)."""
    holding: bool = False
    """The claws are stopped by something between them."""
    body_m: FiniteVec2 | None = None
    body_yaw_rad: Finite = 0.0
    """Where the body stands in the odometry frame."""
    known: tuple[TargetEstimate, ...] = ()
    """Every object in memory."""
    model: str = ""
    """With what it reaches: the rigid body and why, or what was learned and how good that is."""


class LearnedModel(Message):
    """What the robot has learned of its body, as `cocoro.learning.model` writes it: the planner's own, from now on."""

    content: bytes


class ModelRequest(msgspec.Struct, kw_only=True):
    """Take a model over, in place of the one that is used."""

    content: bytes
    """As `cocoro.learning.model` writes it."""


class ModelReply(msgspec.Struct, kw_only=True):
    accepted: bool
    text: str = ""
    """What is used from now on; or why not, and what goes on being used."""


class HandSample(Message):
    """What the arm's babbling saw: joint angles and the hand's marker, both at the frame's stamp, which is this
    message's."""

    draw: Count
    """The number of the draw that the arm was on its way to."""
    angles_rad: dict[str, Finite]
    """Of every joint, neck and hand included."""
    seen_m: FiniteVec3
    """The marker's centre, body frame."""
    area_px: Count


class WheelTrial(Message):
    """What one trial of the wheels' babbling saw: a standing target before and after the wheels turned."""

    trial: Count
    left_mps: Finite
    right_mps: Finite
    """As commanded."""
    way_m: Finite
    turned_rad: Finite
    """What the base's odometry says of the way of the body's origin along its arc, and of the turn."""
    before_m: FiniteVec2
    after_m: FiniteVec2
    """The target over the floor, body frame, each the mean of several frames while the robot stood."""
    height_m: Finite | None = None
    """How high above the floor its centre was seen, at the end."""
