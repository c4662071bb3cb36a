"""A map that goes on learning at work, and notices when the body has changed.

While the errors are of the usual size the map is nudged, so that slow wear is followed. When they are much larger, and
stay so, what was learned is not trusted any more: the network keeps its weights but doubts all of them again, and
follows the new body as fast as it first learned over the drawing. (Forgetting by a constant factor instead is slow: a
direction that hundreds of sightings agreed on gives way only after as many more.) Ours.
"""

from __future__ import annotations

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.learning.fitting import LeastSquares
from cocoro.learning.handmap import HandMap

NUDGE = 0.02
"""Doubt of the weights while all is as usual, in units of a sighting's variance."""
AFRESH = 100.0
"""Doubt once the body has changed."""
MEMORY = 10
"""The size of the errors is judged over about so many sightings."""
SURPRISE = 4.0
"""Mean square of the errors, in units of the usual, beyond which the body has changed."""
WILD_M = 0.15
"""A sighting further off than this is something else than the hand."""


class Adapter:
    """Teaches a map of its own, which begins as a copy of the given one."""

    def __init__(self, learned: HandMap, usual_m: float) -> None:
        """`usual_m`: the map's usual error, root mean square (of the held-out sightings)."""
        self.map = HandMap(
            learned.drawing,
            learned.network.copy(),
            over_drawing=learned.over_drawing,
            coordinates=learned.coordinates,
        )
        self.samples = 0
        self.changes = 0
        """Times that the body was found changed."""
        self._usual2 = max(usual_m, 1e-3) ** 2
        self._learner = LeastSquares(self.map.network, NUDGE)
        self._mean2 = self._usual2
        self._patience = 0

    @property
    def surprise(self) -> float:
        """Mean square of the latest errors, in units of the usual: about 1 while nothing has changed."""
        return self._mean2 / self._usual2

    def add(self, angles_rad: FloatArray, place_m: FloatArray) -> float:
        """One sighting of the hand: angles (n,), place (3,). Returns the error before it was learned, metres."""
        error_m = float(np.linalg.norm(self.map.at(angles_rad) - place_m))
        if error_m > WILD_M:
            return error_m
        self.samples += 1
        self._mean2 += (error_m**2 - self._mean2) / MEMORY
        self._patience -= 1
        if self.surprise > SURPRISE and self._patience <= 0:
            self.changes += 1
            self._patience = 20 * MEMORY  # the errors take a while to become small again
            self._learner = LeastSquares(self.map.network, AFRESH)
        target = self.map.targets(angles_rad[None], place_m[None])[0]
        self._learner.add(angles_rad, target)
        return error_m
