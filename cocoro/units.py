"""Constrained numbers and plain tuples, for configuration and descriptions (bounded ones: `cocoro.messages.common`)."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

Positive = Annotated[float, Meta(gt=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
PositiveShare = Annotated[float, Meta(gt=0, le=1)]

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""x, y, z, w."""
Rgb = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""
