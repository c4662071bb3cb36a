"""Training at work: sightings of the hand train the learned map and the mesh of reachable positions further.

`Adapter` detects a changed body (own method). While errors have their usual size it corrects the map slowly, which
follows wear. When errors are much larger and stay so, the network keeps its weights but their variance is reset, and it
learns the new body as fast as the first one. A constant forgetting factor would be slow: a direction that hundreds of
sightings agree on would take as many new ones to change.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.learning.handmap import HandMap
from cocoro.learning.network import LeastSquares
from services.planning.reachability import ReachMesh
from services.planning.state_estimator import PostureSighting

EVERY_NS = NS // 10
"""Least time between two sightings that are used, as in babbling; nearer ones are nearly equal."""
ROLL_RAD = 0.03
LUMP = 64
"""Positions that are entered into the mesh together: an update takes tenths of a second, for one as for many."""
NUDGE = 0.02
"""Prior variance of the weights while errors are usual, in units of a sighting's variance."""
AFRESH = 100.0
"""Prior variance once the body has changed."""
MEMORY = 10
"""Number of sightings over which errors are averaged."""
SURPRISE = 4.0
"""Mean square error, in units of the usual one, above which the body has changed."""
WILD_M = 0.15
"""A sighting further off than this is not the hand."""


class Adapter:
    """Trains a copy of the given map."""

    def __init__(self, learned: HandMap, usual_m: float) -> None:
        """`usual_m`: the map's usual error, the RMS over held-out sightings."""
        self.map = HandMap(
            learned.nominal,
            learned.network.copy(),
            over_nominal=learned.over_nominal,
            coordinates=learned.coordinates,
        )
        self.samples = 0
        self.changes = 0
        """Number of detected changes of the body."""
        self._usual2 = max(usual_m, 1e-3) ** 2
        self._learner = LeastSquares(self.map.network, NUDGE)
        self._mean2 = self._usual2
        self._patience = 0

    @property
    def surprise(self) -> float:
        """Mean square of the latest errors in units of the usual one; about 1 for an unchanged body."""
        return self._mean2 / self._usual2

    def add(self, angles_rad: FloatArray, place_m: FloatArray) -> float:
        """Learn a sighting: angles (n,) rad, position (3,) metres. Returns the error before that, metres."""
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


class Teacher:
    """Trains a copy of the given map, and the given mesh itself."""

    def __init__(self, learned: HandMap, usual_m: float, mesh: ReachMesh) -> None:
        self._adapter = Adapter(learned, usual_m)
        self._mesh = mesh
        self._nominal = learned.nominal
        self._places: list[FloatArray] = []
        self._last_ns: int | None = None

    @property
    def map(self) -> HandMap:
        return self._adapter.map

    @property
    def text(self) -> str:
        changes = self._adapter.changes
        found = "" if not changes else ", body found changed" + ("" if changes == 1 else f" {changes} times")
        return f"taught by {self._adapter.samples} sightings at work{found}"

    def step(self, sightings: Iterable[PostureSighting]) -> None:
        for sighting in sightings:
            new = self._last_ns is None or not 0 <= sighting.stamp_ns - self._last_ns < EVERY_NS
            if new and self._nominal.holds_at(sighting.angles_rad, ROLL_RAD):
                self._last_ns = sighting.stamp_ns
                self._take(self._nominal.posture(sighting.angles_rad), np.array(sighting.position_m))

    def _take(self, angles_rad: FloatArray, place_m: FloatArray) -> None:
        if self._adapter.add(angles_rad, place_m) > WILD_M:
            return
        self._places.append(place_m)

    def rest(self) -> None:
        """Enter new positions into the mesh; called while the robot is idle."""
        if len(self._places) >= LUMP:
            self._mesh.add(np.array(self._places))
            self._places = []
