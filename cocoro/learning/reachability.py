"""Where the hand can be: a Delaunay triangulation of the places where it was seen, incremental, and honest at hollows.

A triangulation fills the convex hull of its points, and the space that a hand reaches is not convex: there is a hollow
about the shoulder, one where the camera mount stands, and one behind the body. So a tetrahedron counts only when it is
small: when the ball through its corners, empty of sightings by construction, is no larger than the gaps that sightings
so dense would leave (an alpha shape). A place in a larger one is inside the hull, but nobody has seen the hand near it:
that is answered as `unproven`, not as reachable.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
import scipy  # which loads its parts when they are needed: a robot that has learned nothing does without

from cocoro.arrays import BoolArray, FloatArray, IntArray

GAP_FACTOR = 3.0
"""A ball is small while its radius is at most so many times the distance within which sightings have neighbours."""
LEAST_RADIUS_M = 0.03
"""Gaps smaller than this are closed however dense the sightings are elsewhere."""
_LUMP = 64
"""So many places wait until they are entered together: adding to the mesh costs as much for one as for many."""
_GRID_M = 0.004
"""Of two places in one cell of this size the second adds nothing and is left out."""


class Reach(IntEnum):
    OUTSIDE = 0
    """Beyond every place where the hand was seen."""
    UNPROVEN = 1
    """Between places where the hand was seen, but in a gap: it may be a hollow."""
    INSIDE = 2
    """Amidst places where the hand was seen."""


class ReachMesh:
    """The mesh over places (b, 3), body frame, metres. Fewer than five places in general position prove nothing."""

    def __init__(self, places_m: FloatArray | None = None, *, radius_m: float | None = None) -> None:
        """`radius_m`: of the largest ball that counts as small; None derives it from the sightings' own spacing."""
        self._wanted_m = radius_m
        self._mesh: scipy.spatial.Delaunay | None = None
        self._waiting: list[FloatArray] = []
        self._held = np.empty((0, 3))
        self._cells: set[tuple[int, ...]] = set()
        self._small: BoolArray = np.zeros(0, dtype=np.bool_)
        self.radius_m = radius_m if radius_m is not None else LEAST_RADIUS_M
        if places_m is not None and len(places_m):
            self.add(places_m)

    @property
    def places_m(self) -> FloatArray:
        """The places that the mesh is made of, those that wait to be entered included; shape (b, 3)."""
        return np.concatenate([self._held, *self._waiting])

    def add(self, places_m: FloatArray | Sequence[Sequence[float]]) -> None:
        """More places where the hand was seen, shape (b, 3)."""
        self._waiting.append(np.asarray(places_m, dtype=np.float64).reshape(-1, 3))
        if self._mesh is None or sum(map(len, self._waiting)) >= _LUMP:
            self._enter()

    def verdict(self, place_m: Sequence[float] | FloatArray) -> Reach:
        """For one place."""
        return Reach(int(self.verdicts(np.asarray(place_m, dtype=np.float64)[None])[0]))

    def verdicts(self, places_m: FloatArray) -> IntArray:
        """For places (b, 3): their `Reach`, shape (b,)."""
        self._enter()
        if self._mesh is None:
            return np.full(len(places_m), Reach.OUTSIDE)
        simplex = self._mesh.find_simplex(places_m)
        inside = np.where(self._small[simplex], Reach.INSIDE, Reach.UNPROVEN)
        return np.where(simplex < 0, Reach.OUTSIDE, inside)

    def nearest_m(self, place_m: Sequence[float] | FloatArray) -> float:
        """From one place to the nearest at which the hand was seen; infinite where it was nowhere."""
        places = self.places_m
        return float(np.linalg.norm(places - np.asarray(place_m), axis=1).min()) if len(places) else float("inf")

    def volume_m3(self) -> float:
        """Of all that is INSIDE."""
        self._enter()
        if self._mesh is None:
            return 0.0
        corners = self._mesh.points[self._mesh.simplices[self._small]]
        edges = corners[:, 1:] - corners[:, :1]
        return float(np.abs(np.linalg.det(edges)).sum() / 6.0)

    def _enter(self) -> None:
        if not self._waiting:
            return
        fresh = self._thinned(np.concatenate(self._waiting))
        self._waiting = []
        if not len(fresh):
            return
        if self._mesh is None:
            places = np.concatenate([self._held, fresh])
            self._held = places
            if len(places) < 5:
                return
            try:
                self._mesh = scipy.spatial.Delaunay(places, incremental=True)
            except scipy.spatial.QhullError:  # all in one plane so far
                return
        else:
            self._mesh.add_points(fresh)
            self._held = np.concatenate([self._held, fresh])
        self._measure()

    def _thinned(self, places_m: FloatArray) -> FloatArray:
        """One a cell of a fine grid, the first that came: an incremental mesh suffers from doubles."""
        kept = []
        for place, cell in zip(places_m, map(tuple, np.floor(places_m / _GRID_M).astype(int).tolist()), strict=True):
            if cell not in self._cells:
                self._cells.add(cell)
                kept.append(place)
        return np.array(kept).reshape(-1, 3)

    def _measure(self) -> None:
        """Which tetrahedra are small."""
        assert self._mesh is not None
        if self._wanted_m is None:
            distances, _ = scipy.spatial.KDTree(self._held).query(self._held, k=min(4, len(self._held)))
            neighbours = np.asarray(distances)[:, -1]
            self.radius_m = max(LEAST_RADIUS_M, GAP_FACTOR * float(np.quantile(neighbours, 0.75)))
        self._small = _radii_m(self._mesh.points[self._mesh.simplices]) <= self.radius_m
        self._mesh.find_simplex(self._held[:1])  # what it makes for the first question takes long: now, not then


def _radii_m(corners: FloatArray) -> FloatArray:
    """Circumradii of tetrahedra (s, 4, 3), shape (s,); infinite for flat ones. Derived: the centre is as far from each
    corner, which gives three linear equations in its offset from the first."""
    edges = corners[:, 1:] - corners[:, :1]
    lengths2 = (edges**2).sum(axis=2)
    flat = np.abs(np.linalg.det(edges)) < 1e-12
    solid = np.where(flat[:, None, None], np.eye(3), edges)
    centres = np.linalg.solve(solid, lengths2[..., None] / 2)[..., 0]
    return np.where(flat, np.inf, np.linalg.norm(centres, axis=1))
