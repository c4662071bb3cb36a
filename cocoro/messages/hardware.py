"""Messages of camera, base and servos: states, commands, requests."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from cocoro.messages.common import Count, Finite, FiniteNonNegative, FiniteVec2, LatchState, Message, require_finite

STOPPED_BY: dict[LatchState, str] = {"released": "", "latched": "estop", "unknown": "latch unknown"}
"""The field `stopped_by` of a hardware's state, as far as the emergency stop determines it."""


class Frame(Message):
    """One picture of the camera by which the robot finds things: colour, and depth where that camera measures it. The
    pixels decode without a copy, as `memoryview`."""

    width: Annotated[int, Meta(ge=1, le=4096)]
    height: Annotated[int, Meta(ge=1, le=4096)]
    colour: memoryview
    """RGB, 8 bits a channel, row-major: height x width x 3 bytes."""
    depth: memoryview
    """Depth codes as little-endian uint16, row-major: height x width x 2 bytes; empty from a camera without depth. The
    robot's description says what a code is: a Kinect's 11 bits, 2047 = no data, or millimetres, 65535 = no data.
    Seen from the depth camera; the reader registers it to the colour image."""

    def __post_init__(self) -> None:
        pixels = self.width * self.height
        for name, have, want in (("colour", self.colour.nbytes, 3 * pixels), ("depth", self.depth.nbytes, 2 * pixels)):
            if have != want and (have or name != "depth"):
                raise ValueError(f"{name} has {have} bytes, {self.width} x {self.height} needs {want}")

    @property
    def has_depth(self) -> bool:
        return self.depth.nbytes > 0


class PackedRequest(msgspec.Struct, kw_only=True):
    """Asks for the newest frame that the reader does not have yet, packed for a network."""

    after_incarnation: Count = 0
    after_seq: Annotated[int, Meta(ge=-1)] = -1
    """The number of the frame that the reader has; -1 for none."""
    divisor: Annotated[int, Meta(ge=1, le=8)] = 1
    """Of both sides."""
    quality: Annotated[int, Meta(ge=10, le=95)] = 90
    """Of the JPEG picture."""


class PackedFrame(msgspec.Struct, kw_only=True):
    """A frame packed for a network. Stamp and numbers are those of the frame; `services.frames.packing` unpacks it."""

    stamp_ns: int
    seq: Count
    incarnation: Count
    width: Annotated[int, Meta(ge=1, le=4096)]
    height: Annotated[int, Meta(ge=1, le=4096)]
    colour: bytes
    """JPEG."""
    depth: bytes
    """The codes of a `Frame`, by zstd; empty where it has none."""
    held_s: FiniteNonNegative = 0.0
    """How long the packer held the question: until there was a frame, and while it packed that."""


class BaseState(Message):
    """The base: odometry since the service started, its bumpers and its health."""

    odometry_m: FiniteVec2
    """x, y of the body in the odometry frame, whose origin is the body's pose when the service started."""
    odometry_yaw_rad: Finite
    """Heading in the odometry frame, counter-clockwise, not wrapped."""
    speed_mps: Finite
    """Forward speed by odometry."""
    turn_rate_radps: Finite
    """Turn rate by odometry, counter-clockwise."""
    aside_mps: Finite = 0.0
    """Speed to the left by odometry; 0 for a base that cannot move aside."""
    bump_left: bool = False
    bump_right: bool = False
    wheel_drop: bool = False
    cliff: bool = False
    overcurrent: bool = False
    buttons: tuple[str, ...] = ()
    """The pressed buttons of the Create: play, advance."""
    mode: Literal["off", "passive", "safe", "full"] = "full"
    battery_fraction: Annotated[float, Meta(ge=0, le=1)] = 1.0
    battery_v: FiniteNonNegative = 16.0
    charging: bool = False
    latch: LatchState = "unknown"
    stopped_by: str = ""
    """Why the base refuses or zeroes wheel commands ('' when it obeys): estop, latch unknown, bump, cliff, wheel drop,
    overcurrent (also: a wheel is held up), no command, mode (the Create left its mode), link (also: a wheel's servo
    does not answer or does not hold, or the guard is not there)."""

    @property
    def standing(self) -> bool:
        """Whether it moves no faster than what an odometry shows of a base at rest."""
        return abs(self.speed_mps) < 0.01 and abs(self.aside_mps) < 0.01 and abs(self.turn_rate_radps) < 0.03


class BaseCommand(Message):
    """The body's speeds. They are valid for the base's `command_timeout_s`, at higher speeds for less
    (`Base.patience_s`); then the base commands zero. What wheels it has and how fast they turn for that, the base
    knows. A base that cannot move so does not obey."""

    ahead_mps: Finite
    """Of the body frame's origin along its x axis."""
    turn_radps: Finite
    """Counter-clockwise."""
    aside_mps: Finite = 0.0
    """To the left. Only a base whose wheels roll sideways can."""

    def __post_init__(self) -> None:
        require_finite(self, "ahead_mps", "turn_radps", "aside_mps")


class ServoState(Message):
    """The state of one group of joints at one time. Every tuple is in the order of `joints`."""

    joints: tuple[str, ...]
    position_rad: tuple[Finite, ...]
    """Joint angles with sign and zero of the kinematic chain, not the servo's counts."""
    speed_radps: tuple[Finite, ...]
    load: tuple[Finite, ...]
    """Share of the stall torque, -1 to 1; positive when the motor pushes towards greater angles."""
    temperature_c: tuple[Finite, ...] = ()
    voltage_v: tuple[Finite, ...] = ()
    torque_enabled: tuple[bool, ...] = ()
    faults: tuple[str, ...] = ()
    """Latched faults, each 'joint: what', e.g. 'elbow: overload'."""
    latch: LatchState = "unknown"
    stopped_by: str = ""
    """Why the group ignores commands and holds still ('' when it obeys)."""

    def __post_init__(self) -> None:
        for name in ("position_rad", "speed_radps", "load"):
            if len(getattr(self, name)) != len(self.joints):
                raise ValueError(f"{name} has {len(getattr(self, name))} values for {len(self.joints)} joints")


class ServoCommand(Message):
    """Goals for the named joints of one group; the other joints keep their goals. A command is valid for the
    `command_timeout_s` of the group's line. Then an arm or neck joint that still moves holds its position; the hand
    keeps its goal, so that it does not drop an object."""

    joints: tuple[str, ...]
    goal_rad: tuple[Finite, ...]
    speed_radps: tuple[FiniteNonNegative, ...]
    """Speed limits of the motion. 0 holds the joint at its position (the servo itself takes 0 as full speed)."""

    def __post_init__(self) -> None:
        for name in ("goal_rad", "speed_radps"):
            if len(getattr(self, name)) != len(self.joints):
                raise ValueError(f"{name} has {len(getattr(self, name))} values for {len(self.joints)} joints")
        require_finite(self, "goal_rad", "speed_radps")


class RecoverRequest(msgspec.Struct, kw_only=True):
    """Restores the mode of a Create that left it by itself (at a cliff, a wheel drop, the charger), or clears the
    faults of wheels that servos turn."""


class RecoverReply(msgspec.Struct, kw_only=True):
    recovered: bool
    text: str = ""
    """The reason of a failure, and what to do."""


class ServoRequest(msgspec.Struct, kw_only=True):
    """Clears latched faults, releases the torque of joints, or holds them at their positions."""

    action: Literal["clear", "relax", "hold"]
    joints: tuple[str, ...] = ()
    """Joints of the called group; empty means all of them."""


class ServoReply(msgspec.Struct, kw_only=True):
    joints: tuple[str, ...] = ()
    """The joints on which the action succeeded."""
    text: str = ""
    """The failures and their reasons."""
