"""What the renderer draws of the world: coloured primitives, each rigid, each with a pose of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Shape = Literal["box", "cylinder", "sphere"]


@dataclass(frozen=True)
class Visual:
    """One primitive, centred on its own frame; where that frame stands is said by `World.visual_poses`."""

    name: str
    shape: Shape
    size_m: tuple[float, ...]
    """box: full x, y, z; cylinder: radius, height (its axis is z); sphere: radius."""
    rgb: tuple[float, float, float]
    """Surface colour, 0 to 1 a channel."""
