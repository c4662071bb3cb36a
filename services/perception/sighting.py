"""What a detector says of one object in one image, before anything is known of the head."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from cocoro.arrays import FloatArray
from services.perception.image import PixelBox, RgbdImage


@dataclass(frozen=True)
class Evidence:
    """What the depth image says of the object's extent, colour camera's frame (x right, y down, z forward)."""

    surface_m: FloatArray
    """Points on its visible surface, (n, 3)."""
    outline: FloatArray
    """Directions (k, 3), z = 1, of its outermost pixels: each ray meets the object."""
    beside: FloatArray
    """Directions (m, 3), z = 1, of pixels just outside of its outline whose depth is known."""
    free_to_m: FloatArray
    """How far along the optical axis each ray beside is known to pass through nothing, (m,)."""

    @property
    def count(self) -> int:
        return len(self.surface_m) + len(self.outline) + len(self.beside)


@dataclass(frozen=True)
class ImageSighting:
    label: str
    u_px: float
    v_px: float
    area_px: int
    box_px: PixelBox
    depth_m: float | None
    """Of the visible surface, along the optical axis."""
    cut: bool = False
    """It touches the image's edge."""
    hidden: bool = False
    """It is smaller than the whole object, and something nearer may hide the rest."""
    evidence: Evidence | None = None
    """Only from a detector that looks beyond the centroid."""


class Detector(Protocol):
    def detect(self, image: RgbdImage) -> list[ImageSighting]:
        """The known objects in the image, at most one of each label, in the catalogue's order."""
