"""The typed messages of the mesh: SI units, named in the field (`_m`, `_rad`, `_mps`, `_ns`).

Every message is a MessagePack map on the wire, validated when it is decoded. Positions are in the body
frame unless the field says otherwise: x forward, y left, z up, origin on the floor between the drive
wheels. A reader ignores fields that it does not know, so a field with a default may be added at any time.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

LARGEST = 1e12
"""Beyond any quantity of a robot's in SI units: so large a number is a fault, and its square still a number."""
Finite = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
"""MessagePack can carry NaN and infinity; bounds refuse both when a message is decoded."""
NonNegative = Annotated[float, Meta(ge=0, le=LARGEST)]
Count = Annotated[int, Meta(ge=0)]
Vec2 = tuple[Finite, Finite]
Vec3 = tuple[Finite, Finite, Finite]
Quaternion = tuple[Finite, Finite, Finite, Finite]
"""x, y, z, w."""


def _require_finite(message: msgspec.Struct, *names: str) -> None:
    """Refuse NaN and infinity in the named numbers or tuples already when a command is made."""
    for name in names:
        value = getattr(message, name)
        if not all(map(math.isfinite, value if isinstance(value, tuple) else (value,))):
            raise ValueError(f"{name} must be finite, not {value!r}")


class Message(msgspec.Struct, kw_only=True):
    """What every message says of itself; the node fills these three in when it publishes."""

    stamp_ns: int = 0
    """When what the message tells was true, on the robot's clock. A publisher may set it earlier than now."""
    seq: Count = 0
    """Counts up by one for each message of one publisher on one key: a gap is a lost message."""
    incarnation: Count = 0
    """Drawn anew at each start of the publisher, so that a restart is not mistaken for a loss."""


# --- hardware -------------------------------------------------------------------------------------


class Frame(Message):
    """One colour and depth pair of the Kinect. The pixels decode without a copy, as `memoryview`."""

    width: Annotated[int, Meta(ge=1, le=4096)]
    height: Annotated[int, Meta(ge=1, le=4096)]
    colour: memoryview
    """RGB, 8 bits a channel, row-major: height x width x 3 bytes."""
    depth: memoryview
    """Raw 11-bit depth codes as little-endian uint16, row-major: height x width x 2 bytes; 2047 = no data.
    The depth camera's own view: registration to the colour image is the reader's work."""

    def __post_init__(self) -> None:
        pixels = self.width * self.height
        for name, have, want in (
            ("colour", self.colour.nbytes, 3 * pixels),
            ("depth", self.depth.nbytes, 2 * pixels),
        ):
            if have != want:
                raise ValueError(f"{name} has {have} bytes, {self.width} x {self.height} needs {want}")


LatchState = Literal["unknown", "released", "latched"]
"""Of the emergency stop, as a service knows it. Unknown counts as latched: the hardware stays still."""


class BaseState(Message):
    """The Create: odometry since the service started, its bumpers and its health."""

    odometry_m: Vec2
    """x, y of the body in the odometry frame: where the body stood when the service started."""
    odometry_yaw_rad: Finite
    """Heading in the odometry frame, counter-clockwise, not wrapped."""
    speed_mps: Finite
    """Forward speed, as odometry has it."""
    turn_rate_radps: Finite
    """Counter-clockwise, as odometry has it."""
    bump_left: bool = False
    bump_right: bool = False
    wheel_drop: bool = False
    cliff: bool = False
    overcurrent: bool = False
    buttons: tuple[str, ...] = ()
    """Those of the Create's own that are pressed: play, advance."""
    mode: Literal["off", "passive", "safe", "full"] = "full"
    battery_fraction: Annotated[float, Meta(ge=0, le=1)] = 1.0
    battery_v: NonNegative = 16.0
    charging: bool = False
    latch: LatchState = "unknown"
    stopped_by: str = ""
    """Why the base refuses or zeroes wheel commands now ('' when it obeys): estop, latch unknown, bump,
    cliff, wheel drop, overcurrent, no command, mode (the Create left the mode that obeys), link."""


class BaseCommand(Message):
    """Wheel speeds. Valid for 0.15 s at most, and for less the faster they are (`Base.patience_s`): a base that hears
    nothing newer commands zero."""

    left_mps: Finite
    right_mps: Finite

    def __post_init__(self) -> None:
        _require_finite(self, "left_mps", "right_mps")


class ServoState(Message):
    """One servo network, read at one time; every tuple is in the order of `joints`."""

    joints: tuple[str, ...]
    position_rad: tuple[Finite, ...]
    """In the kinematic chain's own sense and zero (the common reference frame), not the servo's counts."""
    speed_radps: tuple[Finite, ...]
    load: tuple[Finite, ...]
    """Signed share of the stall torque, -1 to 1, positive where the motor pushes towards greater angles."""
    temperature_c: tuple[Finite, ...] = ()
    voltage_v: tuple[Finite, ...] = ()
    torque_enabled: tuple[bool, ...] = ()
    faults: tuple[str, ...] = ()
    """Latched faults, each 'joint: what', e.g. 'elbow: overload'."""
    latch: LatchState = "unknown"
    stopped_by: str = ""
    """Why the network holds still whatever is commanded ('' when it obeys)."""

    def __post_init__(self) -> None:
        for name in ("position_rad", "speed_radps", "load"):
            if len(getattr(self, name)) != len(self.joints):
                raise ValueError(f"{name} has {len(getattr(self, name))} values for {len(self.joints)} joints")


class ServoCommand(Message):
    """Goals for the named joints of one network; a joint that is not named keeps its goal. Valid for 0.15 s:
    then an arm or neck joint that is still on its way holds where it is; the hand keeps its goal, so
    that a held object stays held."""

    joints: tuple[str, ...]
    goal_rad: tuple[Finite, ...]
    speed_radps: tuple[NonNegative, ...]
    """Speed limit on the way to the goal. 0 means hold where it is (never 'full speed', as the servo has it)."""

    def __post_init__(self) -> None:
        for name in ("goal_rad", "speed_radps"):
            if len(getattr(self, name)) != len(self.joints):
                raise ValueError(f"{name} has {len(getattr(self, name))} values for {len(self.joints)} joints")
        _require_finite(self, "goal_rad", "speed_radps")


# --- perception -----------------------------------------------------------------------------------


class Detection(msgspec.Struct, kw_only=True):
    """One known object in one frame."""

    label: str
    u_px: Finite
    v_px: Finite
    """Centroid in the colour image, pixels right and down from the top left pixel's centre."""
    area_px: Count
    box_px: tuple[int, int, int, int]
    """left, top, right, bottom of the matching pixels, right and bottom exclusive."""
    depth_m: Finite | None = None
    """Along the optical axis, of the visible surface; None when the depth image has none there."""
    position_m: Vec3 | None = None
    """The object's centre (visible surface carried inwards by the known radius), body frame as the body
    stood at the frame's stamp; None without depth or without head angles for that stamp."""
    note: str = ""
    """Why there is no position, or what makes it doubtful: 'no depth', 'no head angles', 'occluded', 'cut'."""


class Detections(Message):
    """All known objects in one frame. `stamp_ns` is the frame's stamp, not the time of publishing."""

    frame_seq: Count
    frame_incarnation: Count
    width: int
    height: int
    pan_rad: Finite | None = None
    tilt_rad: Finite | None = None
    """The head angles that were used: interpolated at the frame's stamp."""
    detections: tuple[Detection, ...] = ()


class Obstacles(Message):
    """What stands on the floor and where the floor is free, from one depth image; known objects included.
    `stamp_ns` is the frame's. Body frame as the body stood then."""

    points_m: Annotated[tuple[Vec3, ...], Meta(max_length=4096)] = ()
    """One a floor cell of 4 cm in which something stands: its middle x, y, and the height of the highest point seen."""
    free: Annotated[tuple[Vec3, ...], Meta(max_length=1024)] = ()
    """Rays over free floor from `origin_m`: bearing (rad, body frame), and from which to which distance (m) the floor
    is seen; a ray ends before the first thing that stands in it."""
    origin_m: Vec2 = (0.0, 0.0)
    """Where the camera stood, on the floor."""


# --- planning -------------------------------------------------------------------------------------

Behaviour = Literal[
    "idle", "park", "search", "explore", "approach", "reach", "grasp", "lift", "carry", "place", "follow",
    "touch", "go-to", "babble-arm", "babble-wheels",
]  # fmt: skip


class Intent(Message):
    """What the executive wants of the planner. Repeated at the topic's rate: a planner that no longer hears
    it stands still."""

    task_id: str = ""
    step: Count = 0
    """Counts the intents of one run of the executive, so that a status can say which one it answers."""
    behaviour: Behaviour = "idle"
    label: str = ""
    place_m: Vec2 | None = None
    """For 'carry': where to put down, in the odometry frame."""
    distance_m: NonNegative = 0.0
    """For 'go-to': from the body's centre to the target's, over the floor, when it stands there."""
    first: Count = 0
    """For babbling: the number of its first draw."""
    count: Count = 0
    """For babbling: how many samples or trials make an end of it."""


class TargetEstimate(msgspec.Struct, kw_only=True):
    """What the planner believes of one object now: fused over time and carried by odometry."""

    label: str
    position_m: Vec3
    """Centre, body frame, now."""
    velocity_mps: Vec3 = (0.0, 0.0, 0.0)
    """In the odometry frame."""
    sigma_m: Finite = 0.0
    """Standard deviation of the horizontal position."""
    age_s: Finite = 0.0
    """Since the newest frame in which it was localised."""
    odometry_position_m: Vec3 = (0.0, 0.0, 0.0)
    """The same centre in the odometry frame."""


class PlannerStatus(Message):
    """What the planner does and why; the executive decides on it, people read it."""

    task_id: str = ""
    step: Count = 0
    behaviour: Behaviour = "idle"
    state: Literal["running", "done", "failed"] = "running"
    reason: str = ""
    """For 'failed', a word that the executive acts on: lost, unreachable, blocked, slipped, no_grip, stale."""
    why: str = ""
    """One sentence for people: why it does what it does now."""
    target: TargetEstimate | None = None
    distance_m: Finite | None = None
    """What is left to go: to the stopping place when driving, hand to target when reaching."""
    hand_m: Vec3 | None = None
    """Centre between the pads, body frame, felt (from the joint angles)."""
    holding: bool = False
    """The claws are stopped by something between them."""
    body_m: Vec2 | None = None
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
    seen_m: Vec3
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
    before_m: Vec2
    after_m: Vec2
    """The target over the floor, body frame, each the mean of several frames while the robot stood."""
    height_m: Finite | None = None
    """How high above the floor its centre was seen, at the end."""


# --- executive ------------------------------------------------------------------------------------

TaskName = Literal["fetch", "follow", "touch", "go-to", "park", "put-down", "babble-arm", "babble-wheels"]
Outcome = Literal["done", "failed", "cancelled"]


class Phase(msgspec.Struct, kw_only=True):
    name: str
    start_ns: int
    end_ns: int | None = None


class TaskState(Message):
    """The task that runs, or the one that ran last."""

    task_id: str = ""
    task: str = ""
    label: str = ""
    phase: str = "idle"
    text: str = ""
    """What it does now, in words, with the planner's reason."""
    distance_m: Finite | None = None
    started_ns: int = 0
    phases: tuple[Phase, ...] = ()
    outcome: Outcome | None = None
    reason: str = ""
    """For failed and cancelled: not_found, lost, slipped, unreachable, timed_out, ... and words after a colon."""
    elapsed_s: Finite = 0.0


class TaskRequest(msgspec.Struct, kw_only=True):
    task: TaskName
    label: str = ""
    timeout_s: Annotated[float, Meta(gt=0, le=3600)] | None = None
    bring: bool = False
    """Fetch: carry it to where the task began and put it down there."""
    for_s: Annotated[float, Meta(gt=0, le=3600)] | None = None
    """Follow: for so long; None is until cancelled."""
    distance_m: Annotated[float, Meta(ge=0, le=5)] = 0.2
    """Go-to: from the robot's centre to the target's nearest edge, over the floor."""
    first: Count = 0
    """Babbling: the number of its first draw, to go on where an earlier one ended."""
    count: Annotated[int, Meta(ge=1, le=1_000_000)] = 1000
    """Babbling: how many samples or trials make an end of it."""


RefusalCode = Literal[
    "unknown_label", "not_graspable", "busy", "estop", "not_alive", "battery", "holding", "not_holding", "bad_request",
    "no_task",
]  # fmt: skip


class TaskReply(msgspec.Struct, kw_only=True):
    """Accepted with a task's id, or refused with a code and a sentence that says what to do."""

    accepted: bool
    task_id: str = ""
    refusal: RefusalCode | None = None
    text: str = ""


class CancelRequest(msgspec.Struct, kw_only=True):
    task_id: str = ""
    """Empty cancels whatever runs."""


class ObjectsRequest(msgspec.Struct, kw_only=True):
    pass


class KnownObject(msgspec.Struct, kw_only=True):
    label: str
    shape: Literal["cylinder", "sphere", "box"]
    size_m: Vec3
    graspable: bool
    seen: TargetEstimate | None = None


class ObjectsReply(msgspec.Struct, kw_only=True):
    objects: tuple[KnownObject, ...]


# --- safety ---------------------------------------------------------------------------------------


class EstopRequest(msgspec.Struct, kw_only=True):
    """Latch or release the emergency stop; every hardware service and the executive answer it."""

    latched: bool
    by: str = ""


class EstopReply(msgspec.Struct, kw_only=True):
    service: str
    latch: LatchState
    text: str = ""


class RecoverRequest(msgspec.Struct, kw_only=True):
    """Put a Create that left its mode by itself (a cliff, a wheel drop, the charger) back into it."""


class RecoverReply(msgspec.Struct, kw_only=True):
    recovered: bool
    text: str = ""
    """Why not, and what to do."""


class ServoRequest(msgspec.Struct, kw_only=True):
    """Clear latched faults, let joints go limp, or hold them again where they are."""

    action: Literal["clear", "relax", "hold"]
    joints: tuple[str, ...] = ()
    """Of the network that is asked; empty is all of it."""


class ServoReply(msgspec.Struct, kw_only=True):
    joints: tuple[str, ...] = ()
    """For which it was done."""
    text: str = ""
    """What could not be done, and why."""


class Latch(Message):
    """The executive's word on the emergency stop; a restarted hardware service stays still until it hears it."""

    state: LatchState
    by: str = ""


# --- clock, health, records -----------------------------------------------------------------------


class Clock(Message):
    """Simulated time is `stamp_ns`; a new incarnation is a new epoch."""

    rate: Annotated[float, Meta(gt=0, le=1e3)] = 1.0
    """Simulated seconds a real second, as the simulator last measured it."""
    paused: bool = False


class TopicHealth(msgspec.Struct, kw_only=True):
    key: str
    direction: Literal["in", "out"]
    count: Count = 0
    rate_hz: Finite = 0.0
    age_s: Finite | None = None
    """Of the newest sample by its stamp, when the health was taken; None when there was none."""
    skipped: Count = 0
    """State that was overwritten by newer state before it was read."""
    lost: Count = 0
    """Gaps in the sequence: never arrived."""
    rejected: Count = 0
    """Malformed, wrongly typed, oversized, out of order or untimely: counted, dropped."""
    last_error: str = ""
    """Why the last one was rejected."""
    fault: str = ""
    """Of a reader that has rejected messages of late: key, publisher, how many, why. For people."""
    unreadable: bool = False
    """Of a reader: for longer than one can wait, all that came was rejected."""


class LoopHealth(msgspec.Struct, kw_only=True):
    """Of a fixed-rate loop or a driven core, over the last health period."""

    name: str
    rate_hz: Finite = 0.0
    period_median_ms: Finite = 0.0
    period_p99_ms: Finite = 0.0
    step_median_ms: Finite = 0.0
    overruns: Count = 0
    """Periods that were missed altogether since the start."""


class Health(Message):
    service: str
    pid: int = 0
    state: Literal["starting", "ready", "degraded", "stopping"] = "starting"
    text: str = ""
    uptime_s: Finite = 0.0
    cpu_share: Finite = 0.0
    """Of one core, over the last health period."""
    rss_mb: Finite = 0.0
    topics: tuple[TopicHealth, ...] = ()
    loops: tuple[LoopHealth, ...] = ()
    faults: tuple[str, ...] = ()


class StepRecord(Message):
    """What one step of a pure core consumed and gave, in order: enough to execute it again exactly."""

    now_ns: int
    core: str = ""
    consumed: tuple[tuple[str, int, int], ...] = ()
    """(topic, incarnation, seq) in the order in which the core was given them."""
    produced: tuple[tuple[str, int, int], ...] = ()


# --- for the record -------------------------------------------------------------------------------


class Exchange(Message):
    """A request that a service was asked, and what it answered: only the two of them see it otherwise."""

    request: str
    """Its name, e.g. 'executive/run'."""
    question: Any = None
    """As it was asked; None when it could not be understood."""
    answer: Any = None
    error: str = ""
    """In place of an answer."""
    took_ms: NonNegative = 0.0


class AboutRequest(msgspec.Struct, kw_only=True):
    pass


class AboutFile(msgspec.Struct, kw_only=True):
    """A file that a service's configuration names: a learned model, known objects."""

    field: str
    """The configuration's field, e.g. 'objects'."""
    path: str
    sha256: str
    """The file's fingerprint."""
    content: bytes = b""
    """Empty when the file is too large for a message."""


class AboutReply(msgspec.Struct, kw_only=True):
    """What a service is and what it was started with: all that its pure core can be made of again."""

    service: str
    robot: str
    module: str = ""
    """Python's name of the component; empty for what is none."""
    config: Any = None
    """The component's resolved Config, as a map."""
    description: Any = None
    """The robot description that it computes with, as a map."""
    latency_s: NonNegative = 0.0
    record_steps: bool = False
    pid: int = 0
    host: str = ""
    versions: dict[str, str] = {}
    files: tuple[AboutFile, ...] = ()


class DisturbedFile(msgspec.Struct, kw_only=True):
    """Somebody moved or removed a file while it was being recorded."""

    file: str
    """The name that it was recorded under."""
    became: Literal["moved", "removed"]
    """A move to another disk is a copy and a removal."""
    now: str = ""
    """Where it was when that was noticed; '' when that is not known."""
    lost: Count = 0
    """Messages that were in it, when it was removed."""


class Recording(Message):
    """How a recorder is getting on."""

    file: str = ""
    """The MCAP file that is being written; '' when it is not on the disk any more."""
    messages: Count = 0
    """Written since the recorder's start, over all its files, but for those that somebody removed meanwhile."""
    size_bytes: Count = 0
    """The same, as it takes room on the disk."""
    raw_bytes: Count = 0
    """The same, before compression."""
    waiting_bytes: Count = 0
    """Received, not yet written."""
    dropped: dict[str, Count] = {}
    """By key: received, but there was no room to keep them until the disk took them."""
    lost: dict[str, Count] = {}
    """By key: gaps in the sequence, so sent and never received."""
    disturbed: tuple[DisturbedFile, ...] = ()
    """The newest of those that somebody moved or removed while they were being recorded."""
    removed: Count = 0
    """Messages that were in the removed ones, all of them together."""
    longest_sync_ms: NonNegative = 0.0
    """That the disk took to make sure of what it was given."""
    fault: str = ""
    """Why nothing is recorded any more."""
    ended: bool = False
    """The recorder has been told to end, and what it wrote is whole."""


# --- truth: the simulator's own, for tests, the judge and viewers alone ---------------------------


class TrueObject(msgspec.Struct, kw_only=True):
    label: str
    kind: Literal["object", "obstacle"]
    position_m: Vec3
    """Centre, world frame."""
    orientation: Quaternion
    touching: tuple[str, ...] = ()
    """Names of what it touches: robot links ('claw_left'), 'floor', other labels."""


class Truth(Message):
    body_m: Vec3
    """The body frame's origin in the world."""
    body_orientation: Quaternion
    joints_rad: dict[str, Finite]
    """True joint angles."""
    objects: tuple[TrueObject, ...]
    collisions: tuple[str, ...] = ()
    """Contacts of the robot now, other than wheels on floor and claws on object: 'elbow~green_can'."""
