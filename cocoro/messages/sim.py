"""The simulator's messages: its clock, and the truth, which only tests, the judge and viewers may read."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from cocoro.messages.common import Finite, FiniteQuaternion, FiniteVec3, Message


class ClockTick(Message):
    """Simulated time, in `stamp_ns`. A new incarnation is a new epoch."""

    rate: Annotated[float, Meta(gt=0, le=1e3)] = 1.0
    """Simulated seconds per real second, as last measured."""
    paused: bool = False


class TrueObject(msgspec.Struct, kw_only=True):
    label: str
    kind: Literal["object", "obstacle"]
    position_m: FiniteVec3
    """Centre, world frame."""
    orientation: FiniteQuaternion
    touching: tuple[str, ...] = ()
    """Names of the things that it touches: robot links ('claw_left'), 'floor', other labels."""


class Truth(Message):
    body_m: FiniteVec3
    """Origin of the body frame, world frame."""
    body_orientation: FiniteQuaternion
    joints_rad: dict[str, Finite]
    """True joint angles."""
    objects: tuple[TrueObject, ...]
    collisions: tuple[str, ...] = ()
    """Current contacts of the robot except wheels on the floor and claws on an object: 'elbow~green_can'."""
