"""Reachable targets: by the kinematics, and by a mesh over the positions where the hand was seen.

A Delaunay triangulation fills the convex hull of its points, but the space that a hand reaches is not convex: it has
hollows about the shoulder, at the camera mount and behind the body. A tetrahedron therefore counts only if the ball
through its corners, which contains no sighting, is no larger than the gaps between sightings of that density: an alpha
shape (Edelsbrunner and Muecke 1994). Positions in larger tetrahedra are `UNPROVEN`: inside the hull, but the hand was
never seen near.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from math import asin
from typing import NamedTuple

import numpy as np
import scipy  # loads its parts lazily: a robot that has learned nothing does not pay for them

from cocoro.arrays import BoolArray, FloatArray, IntArray
from cocoro.learning.handmap import HandMap
from cocoro.units import Vec3
from services.planning.config import ArmConfig
from services.planning.reach import HandPose, Reacher

GAP_FACTOR = 3.0
"""Largest radius of a small ball, as a multiple of the distance of neighbouring sightings."""
LEAST_RADIUS_M = 0.03
"""Gaps below this radius are closed, however dense the sightings are."""
_LUMP = 64
"""Positions that are entered together: an update of the mesh costs as much for one as for many."""
_GRID_M = 0.004
"""Cell size of the thinning: of several positions in one cell only the first is kept."""
BEYOND_M = 0.15
"""Distance from all sightings beyond which the learned map says nothing."""
RETREAT_STEP_M, RETREAT_STEPS = 0.005, 8
RETREAT_ROOM_M = 0.01
"""The arm must be able to fold in further than where it waits, so that it does not wait at its limits."""
RETREAT_HEIGHTS_M = (0.045, 0.08)


class ReachVerdict(IntEnum):
    """Whether the hand was seen around a position."""

    OUTSIDE = 0
    """Outside of the hull of all sightings."""
    UNPROVEN = 1
    """Between sightings, in a gap that may be a hollow."""
    INSIDE = 2
    """Among sightings."""


class ReachMesh:
    """The mesh over positions (b, 3), body frame, metres, grown incrementally.

    With fewer than five positions in general position every verdict is OUTSIDE.
    """

    def __init__(self, places_m: FloatArray | None = None, *, radius_m: float | None = None) -> None:
        """`radius_m`: radius of the largest ball that counts as small; None derives it from the sightings' spacing."""
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
        """All positions (b, 3), body frame, metres, including those not yet entered."""
        return np.concatenate([self._held, *self._waiting])

    def add(self, places_m: FloatArray | Sequence[Sequence[float]]) -> None:
        """Add positions (b, 3), body frame, metres, where the hand was seen."""
        self._waiting.append(np.asarray(places_m, dtype=np.float64).reshape(-1, 3))
        if self._mesh is None or sum(map(len, self._waiting)) >= _LUMP:
            self._enter()

    def verdict(self, place_m: Sequence[float] | FloatArray) -> ReachVerdict:
        """The verdict on one position (3,), body frame, metres."""
        return ReachVerdict(int(self.verdicts(np.asarray(place_m, dtype=np.float64)[None])[0]))

    def verdicts(self, places_m: FloatArray) -> IntArray:
        """The `ReachVerdict`s (b,) on positions (b, 3), body frame, metres."""
        self._enter()
        if self._mesh is None:
            return np.full(len(places_m), ReachVerdict.OUTSIDE)
        simplex = self._mesh.find_simplex(places_m)
        inside = np.where(self._small[simplex], ReachVerdict.INSIDE, ReachVerdict.UNPROVEN)
        return np.where(simplex < 0, ReachVerdict.OUTSIDE, inside)

    def nearest_m(self, place_m: Sequence[float] | FloatArray) -> float:
        """Distance, metres, from a position (3,) to the nearest sighting; infinite without sightings."""
        places = self.places_m
        return float(np.linalg.norm(places - np.asarray(place_m), axis=1).min()) if len(places) else float("inf")

    def volume_m3(self) -> float:
        """Volume that is INSIDE."""
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
        """The first position (b, 3) in each cell of a fine grid: duplicates would harm the mesh."""
        kept = []
        for place, cell in zip(places_m, map(tuple, np.floor(places_m / _GRID_M).astype(int).tolist()), strict=True):
            if cell not in self._cells:
                self._cells.add(cell)
                kept.append(place)
        return np.array(kept).reshape(-1, 3)

    def _measure(self) -> None:
        """Find the small tetrahedra."""
        assert self._mesh is not None
        if self._wanted_m is None:
            distances, _ = scipy.spatial.KDTree(self._held).query(self._held, k=min(4, len(self._held)))
            neighbours = np.asarray(distances)[:, -1]
            self.radius_m = max(LEAST_RADIUS_M, GAP_FACTOR * float(np.quantile(neighbours, 0.75)))
        self._small = _radii_m(self._mesh.points[self._mesh.simplices]) <= self.radius_m
        self._mesh.find_simplex(self._held[:1])  # builds its search structure now: it takes long


def _radii_m(corners: FloatArray) -> FloatArray:
    """Circumradii (s,), metres, of tetrahedra (s, 4, 3); infinite for flat ones. The centre is equidistant from the
    corners, which gives three linear equations in its offset from the first corner (derived)."""
    edges = corners[:, 1:] - corners[:, :1]
    lengths2 = (edges**2).sum(axis=2)
    flat = np.abs(np.linalg.det(edges)) < 1e-12
    solid = np.where(flat[:, None, None], np.eye(3), edges)
    centres = np.linalg.solve(solid, lengths2[..., None] / 2)[..., 0]
    return np.where(flat, np.inf, np.linalg.norm(centres, axis=1))


class Grasp(NamedTuple):
    """Hand poses for a target: behind it, and around it."""

    behind: HandPose
    around: HandPose


class Reachability:
    def __init__(self, config: ArmConfig, reacher: Reacher) -> None:
        self._config = config
        self._reacher = reacher
        self._upright = reacher.upright
        self._seen: tuple[HandMap, ReachMesh] | None = None
        self._retreat_m: float | None = None

    def use(self, learned: HandMap | None, mesh: ReachMesh | None) -> None:
        """Judge also by the positions where the hand was seen; with None by the kinematics alone."""
        self._seen = (learned, mesh) if learned is not None and mesh is not None else None
        self._retreat_m = None  # the kinematics may have changed, too

    @property
    def retreat_m(self) -> float:
        """Radius about the arm base's axis at which the hand waits behind a target."""
        if self._retreat_m is None:
            self._retreat_m = self._retreat()
        return self._retreat_m

    def _retreat(self) -> float:
        """The configured radius, increased as far as the kinematics in use need it: a hand that is learned to be longer
        than the nominal one folds in less far."""
        config = self._config
        for more in range(RETREAT_STEPS):
            radius = config.retreat_radius_m + more * RETREAT_STEP_M
            poses = [HandPose(radius - RETREAT_ROOM_M, 0.0, height, config.pitch_rad) for height in RETREAT_HEIGHTS_M]
            if all(self._reacher.solve(self._upright, pose) is not None for pose in poses):
                return radius
        return config.retreat_radius_m

    def grasp(self, target_m: Vec3, aside_m: float = 0.0) -> Grasp:
        """The hand poses for a target's centre (x, y, z), body frame, metres, reachable or not. `aside_m`: how far to
        its left the hand's axis goes."""
        config = self._config
        radius, azimuth, height = self._reacher.seen_from_arm(target_m)
        if aside_m != 0.0:
            azimuth += asin(min(max(aside_m / max(radius, 1e-6), -1.0), 1.0))
            radius = max(radius**2 - aside_m**2, 0.0) ** 0.5
        low, high = config.grasp_height_range_m
        height = min(max(height, low), high)
        behind = HandPose(self.retreat_m, azimuth, height, config.pitch_rad)
        return Grasp(behind, behind._replace(radius_m=radius))

    def why_not(self, target_m: Vec3, aside_m: float = 0.0, *, touching: bool = False) -> str:
        """The reason for which a target cannot be grasped (or `touching`: touched) from here; '' when it can.
        `aside_m`: as for `grasp`."""
        config = self._config
        radius_range_m = config.touch_radius_range_m if touching else config.grasp_radius_range_m
        radius, azimuth, height = self._reacher.seen_from_arm(target_m)
        for name, value, (low, high), unit in (
            ("radius", radius, radius_range_m, "m from the arm base"),
            ("azimuth", azimuth, config.grasp_azimuth_range_rad, "rad from the arm base"),
        ):
            if not low <= value <= high:
                return f"its {name} is {value:.2f} {unit}, reachable is {low:.2f} to {high:.2f}"
        if height > config.grasp_height_range_m[1]:
            return f"it is {height:.2f} m high, reachable is up to {config.grasp_height_range_m[1]:.2f}"
        grasp = self.grasp(target_m, aside_m)
        turn = self._reacher.azimuth
        start = self._upright | {turn: self._upright[turn] + azimuth}
        around = self._reacher.solve(start, grasp.around)
        if around is None or self._reacher.solve(start, grasp.behind) is None:
            return "the joint limits do not let the hand there"
        if self._seen is not None:
            learned, mesh = self._seen
            # In gaps between sightings and a little beyond them the nominal model still serves.
            place = learned.at(np.array([around[name] for name in self._reacher.joints]))
            if mesh.verdict(place) is ReachVerdict.OUTSIDE and mesh.nearest_m(place) > BEYOND_M:
                return "the hand was never seen anywhere near"
        return ""
