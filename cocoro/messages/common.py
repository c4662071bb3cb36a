"""What every message has, and the numbers that messages are made of."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

LARGEST = 1e12
"""Beyond any quantity of a robot's in SI units: so large a number is a fault, and its square still a number."""
Finite = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
"""MessagePack can carry NaN and infinity; bounds refuse both when a message is decoded."""
FiniteNonNegative = Annotated[float, Meta(ge=0, le=LARGEST)]
Count = Annotated[int, Meta(ge=0)]
FiniteVec2 = tuple[Finite, Finite]
FiniteVec3 = tuple[Finite, Finite, Finite]
FiniteQuaternion = tuple[Finite, Finite, Finite, Finite]
"""x, y, z, w."""


def require_finite(message: msgspec.Struct, *names: str) -> None:
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


LatchState = Literal["unknown", "released", "latched"]
"""Of the emergency stop, as a service knows it. Unknown counts as latched: the hardware stays still."""
