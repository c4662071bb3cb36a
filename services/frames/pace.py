"""The sizes and qualities in which frames are packed for a network; `cocoro.pace` chooses among them."""

from __future__ import annotations

from typing import NamedTuple


class Level(NamedTuple):
    """How small a frame is packed."""

    divisor: int
    """Of its sides."""
    quality: int
    """Of the JPEG picture."""


LEVELS = (Level(1, 90), Level(1, 75), Level(1, 50), Level(2, 90), Level(2, 75), Level(2, 50))
"""From the best to the smallest; each takes about 0.6 times the bytes of the one before it."""
