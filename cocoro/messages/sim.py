"""The simulator's own: its clock, and the truth, which is for tests, the judge and viewers alone."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from cocoro.messages.common import Finite, FiniteQuaternion, FiniteVec3, Message


class ClockTick(Message):
    """Simulated time is `stamp_ns`; a new incarnation is a new epoch."""

    rate: Annotated[float, Meta(gt=0, le=1e3)] = 1.0
    """Simulated seconds a real second, as the simulator last measured it."""
    paused: bool = False


class TrueObject(msgspec.Struct, kw_only=True):
    label: str
    kind: Literal["object", "obstacle"]
    position_m: FiniteVec3
    """Centre, world frame."""
    orientation: FiniteQuaternion
    touching: tuple[str, ...] = ()
    """Names of what it touches: robot links ('claw_left'), 'floor', other labels."""


class Truth(Message):
    body_m: FiniteVec3
    """The body frame's origin in the world."""
    body_orientation: FiniteQuaternion
    joints_rad: dict[str, Finite]
    """True joint angles."""
    objects: tuple[TrueObject, ...]
    collisions: tuple[str, ...] = ()
    """Contacts of the robot now, other than wheels on floor and claws on object: 'elbow~green_can'."""
