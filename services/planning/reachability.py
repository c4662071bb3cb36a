"""Where the hand can reach: by the kinematics, and by a mesh over the places where it has been seen.

A triangulation fills the convex hull of its points, and the space that a hand reaches is not convex: there is a hollow
about the shoulder, one where the camera mount stands, and one behind the body. So a tetrahedron counts only when it is
small: when the ball through its corners, empty of sightings by construction, is no larger than the gaps that sightings
so dense would leave (an alpha shape). A place in a larger one is inside the hull, but nobody has seen the hand near it:
that is answered as `unproven`, not as reachable.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import scipy  # loads its parts lazily: a robot that has learned nothing does not pay for them

from cocoro.arrays import BoolArray, FloatArray, IntArray
from cocoro.learning.handmap import HandMap
from cocoro.units import Vec3
from services.planning.config import ArmConfig
from services.planning.reach import ARM, HandPose, Reacher

GAP_FACTOR = 3.0
"""A ball is small while its radius is at most so many times the distance within which sightings have neighbours."""
LEAST_RADIUS_M = 0.03
"""Gaps smaller than this are closed however dense the sightings are elsewhere."""
_LUMP = 64
"""So many places wait until they are entered together: adding to the mesh costs as much for one as for many."""
_GRID_M = 0.004
"""Of two places in one cell of this size the second adds nothing and is left out."""
BEYOND_M = 0.15
"""Further than this beyond all places where the hand was seen, what was learned of it says nothing."""
RETREAT_STEP_M, RETREAT_STEPS = 0.005, 8
RETREAT_ROOM_M = 0.01
"""The arm must fold in further than to where it waits, lest it waits at its limits."""
RETREAT_HEIGHTS_M = (0.045, 0.08)
_UPRIGHT = {"arm_base": -0.087, "shoulder": 0.66, "elbow": -1.6, "wrist_pitch": 0.77}
"""Elbow up, hand before the robot: where the search for joint angles starts, so that it stays in that family."""


class ReachVerdict(IntEnum):
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

    def verdict(self, place_m: Sequence[float] | FloatArray) -> ReachVerdict:
        """For one place."""
        return ReachVerdict(int(self.verdicts(np.asarray(place_m, dtype=np.float64)[None])[0]))

    def verdicts(self, places_m: FloatArray) -> IntArray:
        """For places (b, 3): their `ReachVerdict`, shape (b,)."""
        self._enter()
        if self._mesh is None:
            return np.full(len(places_m), ReachVerdict.OUTSIDE)
        simplex = self._mesh.find_simplex(places_m)
        inside = np.where(self._small[simplex], ReachVerdict.INSIDE, ReachVerdict.UNPROVEN)
        return np.where(simplex < 0, ReachVerdict.OUTSIDE, inside)

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


class Grasp(NamedTuple):
    """Where the hand has to go for a target: behind it, and around it."""

    behind: HandPose
    around: HandPose


class Reachability:
    def __init__(self, config: ArmConfig, reacher: Reacher) -> None:
        self._config = config
        self._reacher = reacher
        self._upright = _UPRIGHT | {"wrist_roll": reacher.level_roll_rad}
        self._seen: tuple[HandMap, ReachMesh] | None = None
        self._retreat_m: float | None = None

    def use(self, learned: HandMap | None, mesh: ReachMesh | None) -> None:
        """Judge by where the hand was seen, too, from now on; None: by the kinematics alone."""
        self._seen = (learned, mesh) if learned is not None and mesh is not None else None
        self._retreat_m = None  # the kinematics may have changed, too

    @property
    def retreat_m(self) -> float:
        """Where the hand waits behind a target, from the arm base's axis: no nearer than the arm folds."""
        if self._retreat_m is None:
            self._retreat_m = self._retreat()
        return self._retreat_m

    def _retreat(self) -> float:
        """The configured radius, or as much more as the kinematics that it reaches with want: a hand that is learned to
        be further out than its drawing has it folds less far in."""
        config = self._config
        for more in range(RETREAT_STEPS):
            radius = config.retreat_radius_m + more * RETREAT_STEP_M
            poses = [HandPose(radius - RETREAT_ROOM_M, 0.0, height, config.pitch_rad) for height in RETREAT_HEIGHTS_M]
            if all(self._reacher.solve(self._upright, pose) is not None for pose in poses):
                return radius
        return config.retreat_radius_m

    def grasp(self, target_m: Vec3) -> Grasp:
        """The hand poses for a target's centre (body frame), reachable or not."""
        config = self._config
        radius, azimuth, height = self._reacher.seen_from_arm(target_m)
        low, high = config.grasp_height_range_m
        height = min(max(height, low), high)
        behind = HandPose(self.retreat_m, azimuth, height, config.pitch_rad)
        return Grasp(behind, behind._replace(radius_m=radius))

    def why_not(self, target_m: Vec3, *, touching: bool = False) -> str:
        """Why a target cannot be grasped from here, or just touched; '' when it can."""
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
        grasp = self.grasp(target_m)
        start = self._upright | {"arm_base": _UPRIGHT["arm_base"] + azimuth}
        around = self._reacher.solve(start, grasp.around)
        if around is None or self._reacher.solve(start, grasp.behind) is None:
            return "the joint limits do not let the hand there"
        if self._seen is not None:
            learned, mesh = self._seen
            # In a gap between sightings, and a little beyond them, it may try: there the drawing still serves.
            place = learned.at(np.array([around[name] for name in ARM]))
            if mesh.verdict(place) is ReachVerdict.OUTSIDE and mesh.nearest_m(place) > BEYOND_M:
                return "the hand was never seen anywhere near"
        return ""
