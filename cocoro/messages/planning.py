"""Messages from and to the planner: intents, status, learned models, samples for learning."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from cocoro.messages.actions import ACTIONS
from cocoro.messages.common import Count, Finite, FiniteNonNegative, FiniteVec2, FiniteVec3, Message
from cocoro.messages.driving import Motion


class Intent(Message):
    """The action that the executive asks for, repeated at the topic's rate. Without it the planner stands still."""

    action: Any
    """One of `cocoro.messages.actions`, or a third party's: a map with the action's name in `action`, and its fields.
    A message whose action is unknown or has a bad field is rejected."""
    task_id: str = ""
    step: Count = 0
    """Counts the intents of one run of the executive. The planner's status repeats the number that it answers."""
    motion: Motion | None = None
    """What the operator's hand wants now, for the action `drive`."""
    motion_until_ns: int = 0
    """The motion counts until then, on the robot's clock, whether or not another intent comes."""

    def __post_init__(self) -> None:
        self.action = ACTIONS.read(self.action)


class TargetEstimate(msgspec.Struct, kw_only=True):
    """Estimate of one object now, fused over time and carried along by odometry."""

    label: str
    position_m: FiniteVec3
    """Centre, body frame."""
    velocity_mps: FiniteVec3 = (0.0, 0.0, 0.0)
    """Odometry frame."""
    sigma_m: Finite = 0.0
    """Standard deviation of the horizontal position."""
    age_s: Finite = 0.0
    """Time since the newest frame in which it was localised."""
    odometry_position_m: FiniteVec3 = (0.0, 0.0, 0.0)
    """Centre, odometry frame."""


class PlannerStatus(Message):
    """State of the current action, for the executive's decisions and for people."""

    task_id: str = ""
    step: Count = 0
    behaviour: str = "idle"
    """The name of the action that it carries out."""
    state: Literal["running", "done", "failed"] = "running"
    reason: str = ""
    """For 'failed': the word that the executive decides on (lost, unreachable, blocked, slipped, no_grip, stale)."""
    why: str = ""
    """Reason for what the robot does now, one sentence for people."""
    target: TargetEstimate | None = None
    distance_m: Finite | None = None
    """Remaining distance: to the stopping place when driving, from hand to target when reaching."""
    hand_m: FiniteVec3 | None = None
    """Centre between the pads, body frame, by the joint angles."""
    holding: bool = False
    """Something between the claws stops them."""
    body_m: FiniteVec2 | None = None
    body_yaw_rad: Finite = 0.0
    """Pose of the body in the odometry frame."""
    known: tuple[TargetEstimate, ...] = ()
    """All objects in memory."""
    model: str = ""
    """The body model that it reaches with: the rigid body and why, or the learned model and its error."""


class FloorPlan(Message):
    """What the planner knows of the floor, and the way that it drives on it, for who looks on. Odometry frame. The
    rectangle is as large as what was seen; known objects are no part of it, `PlannerStatus.known` has them."""

    cell_m: FiniteNonNegative
    """Side of a cell."""
    origin_m: FiniteVec2 = (0.0, 0.0)
    """The corner of the first cell with the least x and y."""
    width: Annotated[int, Meta(ge=0, le=240)] = 0
    height: Annotated[int, Meta(ge=0, le=240)] = 0
    """Cells along x, and along y; 0 while nothing was seen."""
    cells: bytes = b""
    """One byte each: 0 not seen, 1 free, 2 occupied. The cell (column, row) is number `row * width + column`; columns
    count along x, rows along y. They are not packed: the result of packing depends on the library, and a step that is
    executed again must give the same bytes everywhere."""
    way_m: Annotated[tuple[FiniteVec2, ...], Meta(max_length=1024)] = ()
    """Places of the way that it means to drive, from the robot on; empty when it has none."""
    goal_m: FiniteVec2 | None = None
    """The place that it drives to: of the object, or where the drive ends."""

    def __post_init__(self) -> None:
        if len(self.cells) != self.width * self.height:
            raise ValueError(f"cells has {len(self.cells)} bytes, {self.width} x {self.height} needs as many cells")


class LearnedModel(Message):
    """Learned model that the planner uses from now on, as `cocoro.learning.model` writes it."""

    content: bytes


class ModelRequest(msgspec.Struct, kw_only=True):
    """Use this model in place of the current one."""

    content: bytes
    """Written by `cocoro.learning.model`."""


class ModelReply(msgspec.Struct, kw_only=True):
    accepted: bool
    text: str = ""
    """The model that is used from now on; for a refusal the reason, and the model that stays in use."""


class HandSample(Message):
    """Sample of the arm's babbling: joint angles and place of the hand's marker at the frame's stamp, which is this
    message's stamp, too."""

    draw: Count
    """Number of the draw that the arm moved to."""
    angles_rad: dict[str, Finite]
    """Angles of all joints, neck and hand included."""
    seen_m: FiniteVec3
    """Centre of the marker, body frame."""
    area_px: Count


class WheelTrial(Message):
    """Sample of the wheels' babbling: places of a standing target before and after the wheels turned."""

    trial: Count
    left_mps: Finite
    right_mps: Finite
    """Commanded speeds."""
    way_m: Finite
    turned_rad: Finite
    """Way of the body's origin along its arc, and turn, by the base's odometry."""
    before_m: FiniteVec2
    after_m: FiniteVec2
    """Places of the target on the floor, body frame; each the median of several frames while the robot stood."""
    height_m: Finite | None = None
    """Height of the target's centre above the floor, seen at the end."""
