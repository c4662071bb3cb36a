"""Learning at work: sightings of the hand go on teaching the map and the mesh of reachable places.

`Adapter` notices when the body has changed (ours). While errors are of the usual size it nudges the map, which follows
slow wear. When errors are much larger and stay so, the network keeps its weights but their variance is reset, and it
learns the new body as fast as it first learned over the nominal model. Forgetting by a constant factor is slow instead:
a direction that hundreds of sightings agreed on gives way only after as many more.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.learning.handmap import HandMap
from cocoro.learning.network import LeastSquares
from services.planning.reach import ARM
from services.planning.reachability import ReachMesh
from services.planning.state_estimator import PostureSighting

EVERY_NS = NS // 10
"""Sightings nearer in time than this are nearly the same; babbling takes no more of them either."""
ROLL_RAD = 0.03
LUMP = 64
"""So many places are entered into the mesh together: it costs some tenths of a second, for one as for many."""
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
            learned.nominal,
            learned.network.copy(),
            over_nominal=learned.over_nominal,
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


class Teacher:
    """Teaches a copy of the map that it is given, and the mesh itself."""

    def __init__(self, learned: HandMap, usual_m: float, mesh: ReachMesh) -> None:
        self._adapter = Adapter(learned, usual_m)
        self._mesh = mesh
        self._roll_rad = learned.nominal.roll_rad
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
            if new and abs(sighting.angles_rad["wrist_roll"] - self._roll_rad) <= ROLL_RAD:
                self._last_ns = sighting.stamp_ns
                self._take(arm_angles(sighting.angles_rad), np.array(sighting.position_m))

    def _take(self, angles_rad: FloatArray, place_m: FloatArray) -> None:
        if self._adapter.add(angles_rad, place_m) > WILD_M:
            return
        self._places.append(place_m)

    def rest(self) -> None:
        """The robot does nothing: time to enter what was seen into the mesh."""
        if len(self._places) >= LUMP:
            self._mesh.add(np.array(self._places))
            self._places = []


def arm_angles(angles_rad: Mapping[str, float]) -> FloatArray:
    """In the order of ARM, shape (4,)."""
    return np.array([angles_rad[name] for name in ARM])
