"""Camera, base and servos: their states, their commands, and what they can be asked."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from cocoro.messages.common import Finite, FiniteNonNegative, FiniteVec2, LatchState, Message, require_finite


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


class BaseState(Message):
    """The Create: odometry since the service started, its bumpers and its health."""

    odometry_m: FiniteVec2
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
    battery_v: FiniteNonNegative = 16.0
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
        require_finite(self, "left_mps", "right_mps")


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
    speed_radps: tuple[FiniteNonNegative, ...]
    """Speed limit on the way to the goal. 0 means hold where it is (never 'full speed', as the servo has it)."""

    def __post_init__(self) -> None:
        for name in ("goal_rad", "speed_radps"):
            if len(getattr(self, name)) != len(self.joints):
                raise ValueError(f"{name} has {len(getattr(self, name))} values for {len(self.joints)} joints")
        require_finite(self, "goal_rad", "speed_radps")


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
