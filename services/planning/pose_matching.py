"""Corrects the body's pose by the walls that depth scans show, and by known objects.

The odometry's error grows with the way: unequal wheels turn the robot by degrees for each metre. An extended Kalman
filter (Thrun, Burgard and Fox 2005, chapter 3) holds the pose and three constants of the odometry. It measures the pose
by scans: their points are matched to lines through the points of earlier scans (Censi 2008), so a wall corrects across
it and in angle, and nothing along it. What several scans agree on comes from the constants, so the pose stays better
where nothing can be seen, too.
"""

from __future__ import annotations

from math import cos, hypot, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from cocoro.arrays import BoolArray, FloatArray
from cocoro.frames import Pose2, wrap_rad

CELL_M = 0.05
_QUARTERS = 4
"""Directions from which a surface is seen are kept apart: a wall has two faces."""
_FROZEN = 12
"""Points after which a reference moves no more: what was seen first was seen from the best known pose."""
_MOST_REFERENCES = 1500
_BEARING_RAD = pi / 120
"""Of the points in such an angle the nearest counts: the face of a wall, not its top."""
_RANGE_M = (0.35, 2.8)
_BESIDE_M, _LEAST_BESIDE = 0.22, 4
"""Distance and number of the references that make a line."""
_THIN_M, _LONG_M, _SLENDER = 0.045, 0.045, 2.2
"""Greatest standard deviation across references that make a line, least along it, and least ratio of the two."""
_SAME_SIDE = 0.3
"""Least cosine between the directions from which two points of one surface are seen."""
_SIGMA_M = 0.02
"""A point's error: the scan's cells have 4 cm."""
_FRAME_SIGMA = (0.02, 0.02, 0.015)
"""Common error of a scan's points, m, m, rad: the head's backlash and lag."""
_LEAST_POINTS, _LEAST_SHARE = 8, 0.5
"""Points that must lie on lines, and their share of those near a line."""
_GATE_M = (0.10, 0.35)
_WILD = 16.0
"""Squared Mahalanobis distance beyond which a match is refused."""
_MARK_M, _MARK_PER_M = 0.02, 0.02
"""Error of a known object's place, and its growth with the distance."""
_FIRST = 3
"""Sightings whose mean is the place of a known object."""
_ROUNDS = 5
_USUAL_M = 1.5
_MOVED_M, _TURNED_RAD, _PANNED_RAD = 0.04, 0.05, 0.30
"""Motion of body and head after which a scan is matched again."""
_SURE_M, _SURE_RAD = 0.12, 0.10
"""Standard deviations beyond which scans do not enter the references."""
_CONSTANTS_SIGMA = (0.008, 0.012, 0.09)
"""Share of the distance, share of the turn, and turn, rad, for each metre: wheels that differ by 2 percent."""
_SLIP_M2, _SLIP_RAD2, _SLIP_TURN_RAD2 = 0.005**2, 0.028**2, 0.010**2
"""Variances by wheel slip: of the distance and of the heading for each metre, of the heading for each rad."""


class Constants(NamedTuple):
    """Constant errors of the odometry."""

    distance: float = 0.0
    """Share by which a distance is longer."""
    turn: float = 0.0
    """Share by which a turn is larger."""
    veer_radpm: float = 0.0
    """Turn on each metre."""

    def step(self, step: Pose2) -> Pose2:
        """Correct a step of the odometry."""
        extra_rad = self.turn * step.yaw_rad + self.veer_radpm * step.x_m
        share, c, s = 1.0 + self.distance, cos(extra_rad / 2), sin(extra_rad / 2)
        x_m, y_m = share * step.x_m, share * step.y_m
        return Pose2(c * x_m - s * y_m, s * x_m + c * y_m, step.yaw_rad + extra_rad)


class Matched(NamedTuple):
    """The lines to which places belong."""

    middle_m: FloatArray
    """A point of each line, (n, 2)."""
    normal: FloatArray
    """(n, 2)."""
    variance_m2: FloatArray
    """Of the references about the line, (n,)."""
    doubt: FloatArray
    """Variance of the pose from which each line's reference was entered: x, y in m2, yaw in rad2, (n, 3)."""
    exists: BoolArray
    """Whether a place has a line, (n,)."""


class References:
    """Places of surfaces in the corrected frame, by cell and by the side from which they are seen."""

    def __init__(self) -> None:
        self._rows: dict[tuple[int, int, int], int] = {}
        self._sums = np.zeros((_MOST_REFERENCES, 7))
        self._count = np.zeros(_MOST_REFERENCES, dtype=np.int64)

    def clear(self) -> None:
        self._rows.clear()
        self._sums[:] = 0.0
        self._count[:] = 0

    def enter(self, places_m: FloatArray, towards: FloatArray, doubt: FloatArray) -> None:
        """Enter places (n, 2), seen from the directions (n, 2), unit vectors. `doubt`: the variance of the pose that
        they were seen from, (3,)."""
        cells = np.floor(places_m / CELL_M).astype(np.int64)
        quarters = np.floor(np.arctan2(towards[:, 1], towards[:, 0]) / (2 * pi / _QUARTERS)).astype(np.int64)
        for (x, y), quarter, place, way in zip(cells.tolist(), quarters.tolist(), places_m, towards, strict=True):
            row = self._rows.setdefault((x, y, quarter), len(self._rows))
            if row >= _MOST_REFERENCES:
                del self._rows[(x, y, quarter)]
            elif self._count[row] < _FROZEN:
                self._sums[row] += (*place, *way, *doubt)
                self._count[row] += 1

    def look(self) -> Lines:
        """The lines through the references as they are now."""
        n = len(self._rows)
        means = self._sums[:n] / np.maximum(self._count[:n, None], 1)
        return Lines(means[:, :2], means[:, 2:4], means[:, 4:])


class Lines:
    """Lines through references, each worked out when it is first asked for."""

    def __init__(self, spots_m: FloatArray, ways: FloatArray, doubts: FloatArray) -> None:
        """`spots_m`: the references' places (n, 2); `ways`: the directions from which they were seen (n, 2); `doubts`:
        the variances of the poses from which they were seen (n, 3)."""
        self._spots, self._ways, self._doubts = spots_m, ways, doubts
        self._known: dict[int, tuple[FloatArray, FloatArray, float] | None] = {}

    def nearest(self, places_m: FloatArray, ways: FloatArray, within_m: float) -> Matched:
        """The line of the reference that is nearest to each place (n, 2) seen from a direction (n, 2)."""
        n = len(places_m)
        matched = Matched(np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n), np.zeros((n, 3)), np.zeros(n, dtype=bool))
        if not len(self._spots):
            return matched
        x, y = (places_m[:, None] - self._spots[None]).transpose(2, 0, 1)
        away = np.where(ways @ self._ways.T < _SAME_SIDE, np.inf, x**2 + y**2)
        nearest = away.argmin(axis=1)
        near = away[np.arange(n), nearest] < within_m**2
        for number in sorted(set(nearest[near].tolist())):
            if number not in self._known:
                self._known[number] = self._line(number)
            line = self._known[number]
            if line is not None:
                theirs = near & (nearest == number)
                matched.middle_m[theirs], matched.normal[theirs], matched.variance_m2[theirs] = line
                matched.doubt[theirs] = self._doubts[number]
                matched.exists[theirs] = True
        return matched

    def _line(self, number: int) -> tuple[FloatArray, FloatArray, float] | None:
        beside = np.hypot(*(self._spots - self._spots[number]).T) < _BESIDE_M
        spots = self._spots[beside & (self._ways @ self._ways[number] > _SAME_SIDE)]
        if len(spots) < _LEAST_BESIDE:
            return None
        (across, along), axes = np.linalg.eigh(np.cov(spots.T, bias=True))
        if across > _THIN_M**2 or along < max(_LONG_M**2, _SLENDER**2 * across):
            return None
        return spots.mean(axis=0), axes[:, 0], max(float(across), 0.0)


class Mark(NamedTuple):
    """A known object by which the pose is corrected."""

    place_m: FloatArray
    """Mean place of its first sightings, corrected frame, (2,)."""
    sightings: int
    doubt: FloatArray
    """Variance of the pose at its first sighting: x, y in m2, yaw in rad2, (3,)."""
    from_: Pose2
    """The odometry's pose at the last sighting that counted."""


class PoseMatching:
    def __init__(self) -> None:
        self._references = References()
        self.clear()

    def clear(self) -> None:
        """Begin a new frame."""
        self._references.clear()
        self.constants = Constants()
        self.shift: Pose2 | None = None
        """The odometry frame's pose in the corrected frame; None while nothing is corrected."""
        self._covariance = np.diag([0.0, 0.0, 0.0, *np.square(_CONSTANTS_SIGMA)])
        self._doubt = np.zeros((3, 3))
        """Covariance of the pose since the search began. The filter's own is that of the pose among the references: it
        knows nothing of the error that they have in common, which grows from each to those that are entered by it."""
        self._marks: dict[str, Mark] = {}
        self._task_id = ""
        self._matched: tuple[Pose2, float] | None = None
        """The odometry's pose and the head's pan at the last scan that was matched."""

    def follow(self, task_id: str) -> None:
        """Begin a new frame of references when another task begins to search: a place counts from its begin."""
        if task_id != self._task_id:
            self._task_id = task_id
            self._references.clear()
            self._marks.clear()
            self._covariance[:3] = self._covariance[:, :3] = 0.0
            self._doubt[:] = 0.0
            self._matched = None

    def place(self, odometry: Pose2) -> Pose2:
        """The corrected pose."""
        return odometry if self.shift is None else self.shift.compose(odometry)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the place."""
        return float(np.sqrt(np.linalg.eigvalsh(self._covariance[:2, :2])[-1].clip(0.0)))

    @property
    def sigma_rad(self) -> float:
        return float(np.sqrt(self._covariance[2, 2]))

    @property
    def doubt_m(self) -> float:
        """Standard deviation of the floor that is seen at the usual distance, with the error of the references."""
        place_m2 = float(np.linalg.eigvalsh(self._doubt[:2, :2])[-1].clip(0.0))
        return sqrt(place_m2) + sqrt(self._doubt[2, 2]) * _USUAL_M

    def moved(self, before: Pose2, after: Pose2) -> None:
        """Note a step of the odometry."""
        if before == after:
            return
        x, y, yaw = before.inverse().compose(after)
        turn = wrap_rad(yaw)
        heading = self.place(before).yaw_rad + turn / 2
        dx, dy = cos(heading) * x - sin(heading) * y, sin(heading) * x + cos(heading) * y
        change = np.eye(6)
        change[0, 2], change[1, 2] = -dy, dx
        change[:3, 3:] = [[dx, 0.0, 0.0], [dy, 0.0, 0.0], [0.0, turn, x]]
        length = hypot(x, y)
        slip = np.array([_SLIP_M2 * length, _SLIP_M2 * length, _SLIP_RAD2 * length + _SLIP_TURN_RAD2 * abs(turn)])
        before_pose = self._covariance[:3, :3].copy()
        self._covariance = change @ self._covariance @ change.T
        self._covariance[[0, 1, 2], [0, 1, 2]] += slip
        # What a wrong constant adds depends on it, not on the pose.
        turned = change[:3, :3]
        self._doubt = turned @ self._doubt @ turned.T
        self._doubt += self._covariance[:3, :3] - turned @ before_pose @ turned.T

    def scan(self, points_m: FloatArray, origin_m: tuple[float, float], odometry: Pose2, pan_rad: float) -> bool:
        """Match a scan's points (n, 2), body frame, seen from a place, and enter them; whether the pose changed."""
        points, ways = _faces(points_m, np.array(origin_m))
        changed = False
        if len(points) >= _LEAST_POINTS and self._due(odometry, pan_rad):
            self._matched = odometry, pan_rad
            changed = self._match(points, ways, odometry)
        if self.sigma_m < _SURE_M and self.sigma_rad < _SURE_RAD:
            pose = self.place(odometry)
            self._references.enter(
                _moved(points, pose), _moved(ways, Pose2(yaw_rad=pose.yaw_rad)), self._doubt.diagonal()
            )
        return changed

    def _due(self, odometry: Pose2, pan_rad: float) -> bool:
        if self.sigma_rad == 0.0:
            return False
        if self._matched is None:
            return True
        then, pan = self._matched
        step = then.inverse().compose(odometry)
        return (
            hypot(step.x_m, step.y_m) >= _MOVED_M
            or abs(wrap_rad(step.yaw_rad)) >= _TURNED_RAD
            or abs(pan - pan_rad) >= _PANNED_RAD
        )

    def _match(self, points: FloatArray, ways: FloatArray, odometry: Pose2) -> bool:
        pose = self.place(odometry)
        expected = self._covariance[:3, :3] + np.diag(np.square(_FRAME_SIGMA))
        prior = np.linalg.inv(expected)
        gate_m = float(np.clip(2.5 * (self.sigma_m + self.sigma_rad), *_GATE_M))
        off = np.zeros(3)
        information = np.zeros((3, 3))
        lines = self._references.look()
        for number in range(_ROUNDS):
            now = Pose2(pose.x_m + off[0], pose.y_m + off[1], pose.yaw_rad + off[2])
            places = _moved(points, now)
            matched = lines.nearest(places, _moved(ways, Pose2(yaw_rad=now.yaw_rad)), gate_m)
            known = matched.exists
            if known.sum() < _LEAST_POINTS:
                return False
            arms, normal = places[known] - (now.x_m, now.y_m), matched.normal[known]
            rest = ((places - matched.middle_m)[known] * normal).sum(axis=1)
            slope = np.column_stack([normal, normal[:, 1] * arms[:, 0] - normal[:, 0] * arms[:, 1]])
            variance = _SIGMA_M**2 + matched.variance_m2[known]
            scale = 4.0 if number < 2 else 2.0
            weight = 1.0 / (1.0 + np.square(rest / scale) / variance) / variance
            information = (slope * weight[:, None]).T @ slope
            step = np.linalg.solve(information + prior, -(slope * weight[:, None]).T @ rest - prior @ off)
            off = off + step
            if np.abs(step).max() < 1e-4:
                break
        fits = np.abs(rest) < 2 * np.sqrt(variance)
        if fits.sum() < _LEAST_POINTS or fits.mean() < _LEAST_SHARE or off @ prior @ off > _WILD:
            return False
        gain = self._covariance[:, :3] @ prior
        change = gain @ off
        left = np.linalg.inv(prior + information)
        self._covariance -= gain @ (expected - left) @ gain.T
        self._doubt_less(matched.doubt[known].mean(axis=0))
        self._correct(change, odometry)
        return True

    def _doubt_less(self, theirs: FloatArray) -> None:
        """After a match the pose is in doubt as its references are (3,), and as it is among them."""
        now = theirs + self._covariance[:3, :3].diagonal()
        share = np.sqrt(np.clip(now / np.maximum(self._doubt.diagonal(), 1e-12), 0.0, 1.0))
        self._doubt = self._doubt * share[:, None] * share

    def sight(self, label: str, place_m: tuple[float, float], odometry: Pose2) -> bool:
        """Compare where a known object is seen, body frame, with where it was seen first; whether the pose changed. An
        object that stands elsewhere by more than the doubt was moved, and is a new one."""
        pose = self.place(odometry)
        there = np.array(pose.apply((*place_m, 0.0))[:2])
        mark = self._marks.get(label)
        if mark is None or mark.sightings < _FIRST:
            if self.sigma_m < _SURE_M and self.sigma_rad < _SURE_RAD:
                mark = mark or Mark(there, 0, self._doubt.diagonal().copy(), odometry)
                mean_m = mark.place_m + (there - mark.place_m) / (mark.sightings + 1)
                self._marks[label] = Mark(mean_m, mark.sightings + 1, mark.doubt, odometry)
            return False
        step = mark.from_.inverse().compose(odometry)
        if hypot(step.x_m, step.y_m) < _MOVED_M and abs(wrap_rad(step.yaw_rad)) < _TURNED_RAD:
            return False
        x, y = (there - (pose.x_m, pose.y_m)).tolist()
        slope = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
        noise = (_MARK_M + _MARK_PER_M * hypot(x, y)) ** 2 * np.eye(2)
        expected = slope @ self._covariance[:3, :3] @ slope.T + noise
        rest = mark.place_m - there
        if rest @ np.linalg.solve(expected, rest) > _WILD:
            del self._marks[label]
            return False
        gain = self._covariance[:, :3] @ slope.T @ np.linalg.inv(expected)
        self._covariance -= gain @ expected @ gain.T
        self._doubt_less(mark.doubt)
        self._correct(gain @ rest, odometry)
        self._marks[label] = mark._replace(from_=odometry)
        return True

    def _correct(self, change: FloatArray, odometry: Pose2) -> None:
        """Change the pose (x, y, yaw) and the constants (3,)."""
        self._covariance = (self._covariance + self._covariance.T) / 2
        pose = self.place(odometry)
        x_m, y_m, yaw_rad = change[:3].tolist()
        better = Pose2(pose.x_m + x_m, pose.y_m + y_m, pose.yaw_rad + yaw_rad)
        self.shift = better.compose(odometry.inverse())
        self.constants = Constants(*(np.array(self.constants) + change[3:]).tolist())


def _faces(points_m: FloatArray, origin_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The nearest point in each direction, and the unit vectors from these to the camera, each (k, 2)."""
    away = points_m - origin_m
    distance = np.hypot(away[:, 0], away[:, 1])
    near = (distance > _RANGE_M[0]) & (distance < _RANGE_M[1])
    points_m, away, distance = points_m[near], away[near], distance[near]
    bearing = np.floor(np.arctan2(away[:, 1], away[:, 0]) / _BEARING_RAD).astype(np.int64)
    order = np.lexsort((distance, bearing))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(bearing[order]) != 0
    kept = order[first]
    return points_m[kept], -away[kept] / distance[kept, None]


def _moved(points_m: FloatArray, pose: Pose2) -> FloatArray:
    c, s = cos(pose.yaw_rad), sin(pose.yaw_rad)
    moved: FloatArray = points_m @ np.array([[c, s], [-s, c]]) + np.array([pose.x_m, pose.y_m])
    return moved
