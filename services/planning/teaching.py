"""Learning on the job: the hand's sightings at work go on teaching the map, and the mesh of where the hand can be."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.learning.handmap import HandMap
from cocoro.learning.reachability import ReachMesh
from services.planning.adapt import WILD_M, Adapter
from services.planning.reach import ARM, LEVEL_ROLL_RAD
from services.planning.state_estimator import Sighting

EVERY_NS = NS // 10
"""Sightings nearer in time than this are nearly the same; babbling takes no more of them either."""
ROLL_RAD = 0.03
LUMP = 64
"""So many places are entered into the mesh together: it costs some tenths of a second, for one as for many."""


class Teacher:
    """Teaches a copy of the map that it is given, and the mesh itself."""

    def __init__(self, learned: HandMap, usual_m: float, mesh: ReachMesh) -> None:
        self._adapter = Adapter(learned, usual_m)
        self._mesh = mesh
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

    def step(self, sightings: Iterable[Sighting]) -> None:
        for sighting in sightings:
            new = self._last_ns is None or not 0 <= sighting.stamp_ns - self._last_ns < EVERY_NS
            if new and abs(sighting.angles_rad["wrist_roll"] - LEVEL_ROLL_RAD) <= ROLL_RAD:
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
