"""Fields of every message, and the numeric types of messages."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

LARGEST = 1e12
"""Bound of all numbers in messages: beyond any quantity of a robot in SI units, and its square is still finite."""
Finite = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
"""MessagePack can carry NaN and infinity; bounds refuse both when a message is decoded."""
FiniteNonNegative = Annotated[float, Meta(ge=0, le=LARGEST)]
Count = Annotated[int, Meta(ge=0)]
FiniteVec2 = tuple[Finite, Finite]
FiniteVec3 = tuple[Finite, Finite, Finite]
FiniteQuaternion = tuple[Finite, Finite, Finite, Finite]
"""x, y, z, w."""


def require_finite(message: msgspec.Struct, *names: str) -> None:
    """Raises ValueError when one of the named fields (numbers or tuples of numbers) is NaN or infinite."""
    for name in names:
        value = getattr(message, name)
        if not all(map(math.isfinite, value if isinstance(value, tuple) else (value,))):
            raise ValueError(f"{name} must be finite, not {value!r}")


class Message(msgspec.Struct, kw_only=True):
    """Base of all messages. The node sets the three fields when it publishes."""

    stamp_ns: int = 0
    """Time at which the content was true, on the robot's clock. A publisher may set it earlier than now."""
    seq: Count = 0
    """Number of the message among those of one publisher on one key; a gap means lost messages."""
    incarnation: Count = 0
    """Random number of the publisher's start, so that a restart is not taken for a loss."""


LatchState = Literal["unknown", "released", "latched"]
"""State of the emergency stop in a service. Unknown counts as latched: the hardware stays still."""
