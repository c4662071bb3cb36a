"""Sightings of the hand as arrays."""

from __future__ import annotations

from dataclasses import dataclass

from cocoro.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Sightings:
    """Sightings as arrays: angles (b, n) rad, positions (b, 3) m in the body frame, numbers of the draws (b,)."""

    angles_rad: FloatArray
    places_m: FloatArray
    draws: IntArray

    def __len__(self) -> int:
        return len(self.draws)

    def pick(self, mask: BoolArray | slice) -> Sightings:
        """The sightings of a mask (b,) or slice."""
        return Sightings(self.angles_rad[mask], self.places_m[mask], self.draws[mask])
