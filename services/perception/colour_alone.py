"""Places known objects by colour alone, for a camera without depth.

An object is taken to stand on the floor that the robot drives on. Three measurements tell its distance: the ray through
its foot, the lowest row of its region, meets the floor; the one through its top meets the height of the known object;
and its outline is as large as the known object's there. Each has a standard deviation: the first two by the row and by
the camera's tilt, growing with the square of the distance, the third by the outline's edge.

Foot and outline, weighted, are the place of an object that is seen whole. Where the top says nearer than the foot, a
part is hidden: of what stands on the floor, before a camera that looks down, that is the foot, so the top counts, and
the detection is doubtful. Where the top says farther, it does not stand on the floor; then the outline alone counts.
(Derived; the ray's foot as in single-view metrology, Criminisi 2000.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from math import atan2, cos, hypot, inf, isfinite, log, pi, sin, sqrt
from typing import NamedTuple

import cv2
import numpy as np

from cocoro.arrays import FloatArray
from cocoro.messages import Detection
from cocoro.objects import Catalogue, ObjectSpec
from cocoro.robot import Camera, Robot
from services.perception.image import ImageSighting
from services.perception.localise import SAME_PLACE, Localiser, detection_of

EDGE_PX = 0.8
"""Standard deviation of an edge of a region, px, at any resolution."""
TILT_RAD = 0.005
"""Standard deviation of the camera's tilt against the floor, which an own calibration of its mount reaches."""
HEIGHT_SHARE = 0.01
"""The same of the camera's height above the floor."""
SIZE_SHARE = 0.02
"""The same of the object's size and of the focal length."""
CONTRADICT = 3.0
"""Standard deviations between two distances from which they contradict each other."""
HIDDEN_PART = 0.25
"""Of an object that is hidden in part: its distance's standard deviation as a share of what foot and top differ by."""
LEAST_SHARE, MOST_SHARE = 0.15, 1.7
"""Shares of the pixels that the object would have where it stands. Outside of them, it is another thing."""
MOST_MISFIT, DOUBTFUL, SEEN_THERE, SAME_M = 8.0, 2.0, 10.0, 0.15
"""Of two labels of one region the one with the smaller misfit wins. Most that the sides' ratio counts; what a doubtful
one has more; what one has less that won within so many metres in the picture before: a can behind the own hand may
look like a ball."""
WIDER = 5.0
"""Standard deviations by which a region that the picture's edge cuts may be wider than the object."""
HIGHEST_M = 0.6
"""Greatest height of an object's middle that the robot can hold up."""
UNDER_FLOOR_M = 0.04
CIRCLE = np.linspace(0.0, 2 * pi, 24, endpoint=False)
STEPS = 12
NEAREST_M, FARTHEST_M = 0.05, 20.0
LEAST_ABOVE_M = 0.05
"""A camera that is less above an object's top does not see it as one that looks down."""


class Placed(NamedTuple):
    """An object's place by one picture."""

    centre_m: FloatArray
    """Body frame, (3,)."""
    sigma_m: float
    """Standard deviation of its distance."""
    note: str
    misfit: float
    """How badly the region's outline fits the known object there; among two labels of one region the lower one wins."""


class ColourLocaliser(Localiser):
    """As `Localiser`, for sightings without depth."""

    def __init__(self, robot: Robot, catalogue: Catalogue, occluded_share: float) -> None:
        super().__init__(robot, catalogue, occluded_share)
        self._range_m = robot.eye.max_range_m
        self._before: dict[str, FloatArray] = {}
        """Where the objects were in the picture before, body frame, (3,)."""

    def locate(
        self, sightings: Sequence[ImageSighting], camera: Camera, angles_rad: FloatArray | None
    ) -> list[Detection]:
        if angles_rad is None:
            return [detection_of(sighting, None, "no head angles") for sighting in sightings]
        pose = self.camera_pose(angles_rad)
        found: dict[str, Placed] = {}
        for sighting in sightings:
            placed = place(sighting, self._catalogue[sighting.label], camera, pose, self._occluded_share)
            if placed is not None and hypot(*placed.centre_m[:2]) <= self._range_m:
                found[sighting.label] = placed
        seen = [sighting for sighting in sightings if sighting.label in found]
        misfit = {label: self._misfit(label, placed) for label, placed in found.items()}
        order = {sighting.label: (misfit[sighting.label], number) for number, sighting in enumerate(seen)}
        lost = {one.label for one, other in _together(seen) if order[one.label] > order[other.label]}
        self._before = {label: placed.centre_m for label, placed in found.items() if label not in lost}
        detections = []
        for sighting in seen:
            if sighting.label not in lost:
                placed = found[sighting.label]
                x, y, z = placed.centre_m.tolist()
                detections.append(detection_of(sighting, (x, y, z), placed.note, placed.sigma_m))
        return detections

    def _misfit(self, label: str, placed: Placed) -> float:
        before = self._before.get(label)
        there = before is not None and float(np.linalg.norm(placed.centre_m - before)) < SAME_M
        return placed.misfit + DOUBTFUL * bool(placed.note) - SEEN_THERE * there


def place(
    sighting: ImageSighting, known: ObjectSpec, camera: Camera, pose: FloatArray, occluded_share: float
) -> Placed | None:
    """Place an object. `pose`: the camera's in the body frame, 4 x 4. None where it is no such object."""
    view = _View(known, camera, pose)
    left, top, right, bottom = sighting.box_px
    beside = left <= 1 or right >= camera.width - 1
    ray = pose[:3, :3] @ camera.ray(sighting.u_px, sighting.v_px)
    bearing = atan2(ray[1], ray[0])
    # A region's outermost pixels reach half a pixel beyond their centres.
    foot_m = inf if bottom >= camera.height - 1 else view.by_foot(bearing, bottom - 0.5)
    top_m = inf if top <= 1 else view.by_top(bearing, top - 0.5)
    if sighting.cut:
        away_m = min(foot_m, top_m)
        if not isfinite(away_m):
            return None
        wider = view.width_misfit(bearing, away_m, right - left)
        if sighting.area_px > MOST_SHARE * view.counted_px(bearing, away_m) or wider > WIDER:
            return None
        sigma_m = view.foot_sigma_m(away_m) if away_m == foot_m else view.top_sigma_m(away_m)
        aside_m = (right - left) / 2 * away_m / camera.fx if beside else 0.0
        misfit = min(0.5 * wider**2, MOST_MISFIT) if wider > 0 or not beside else 0.0
        return Placed(view.standing_m(bearing, away_m), hypot(sigma_m, aside_m), "cut", misfit)
    size_m = view.by_size(bearing, float(sighting.area_px))
    apart_m = foot_m - top_m if isfinite(foot_m) and isfinite(top_m) else (inf if isfinite(top_m) else -inf)
    doubt_m = view.edges_sigma_m(top_m if isfinite(top_m) else foot_m) if apart_m > -inf else 1.0
    if apart_m > CONTRADICT * doubt_m:
        hidden_m = min(HIDDEN_PART * apart_m, known.size_m[2])
        share = sighting.area_px / view.counted_px(bearing, top_m)
        if not LEAST_SHARE < share < MOST_SHARE:
            return None
        sigma_m = hypot(view.top_sigma_m(top_m), hidden_m)
        return Placed(view.standing_m(bearing, top_m), sigma_m, "occluded", abs(log(share)))
    aspect = view.aspect_misfit(bearing, foot_m if isfinite(foot_m) else size_m, sighting)
    if apart_m < -CONTRADICT * doubt_m:
        return _raised(view, known, ray, size_m, aspect)
    share = sighting.area_px / view.counted_px(bearing, foot_m)
    if not LEAST_SHARE < share < MOST_SHARE:
        return None
    foot_sigma, size_sigma = view.foot_sigma_m(foot_m), view.size_sigma_m(size_m)
    if share < occluded_share:  # something hides a side
        return Placed(view.standing_m(bearing, foot_m), foot_sigma, "occluded", aspect)
    weights = np.array([foot_sigma, size_sigma]) ** -2.0
    fused_m = float(weights @ np.array([foot_m, size_m]) / weights.sum())
    apart = abs(foot_m - size_m) / hypot(foot_sigma, size_sigma)
    note = "occluded" if apart > CONTRADICT else ""
    fit = min(aspect + 0.5 * apart**2, MOST_MISFIT)
    return Placed(view.standing_m(bearing, fused_m), float(1 / sqrt(weights.sum())), note, fit)


def _raised(view: _View, known: ObjectSpec, ray: FloatArray, size_m: float, aspect: float) -> Placed | None:
    """An object that does not stand on the floor: the robot holds it, or it is no such object."""
    if not isfinite(size_m):
        return None
    centre, sigma_m = view.along_m(ray, size_m), view.size_sigma_m(size_m)
    if not known.size_m[2] / 2 - UNDER_FLOOR_M < centre[2] < HIGHEST_M:
        return None
    return Placed(centre, sigma_m, "occluded", min(aspect + 0.5 * CONTRADICT**2, MOST_MISFIT))


def _together(sightings: Sequence[ImageSighting]) -> Iterator[tuple[ImageSighting, ImageSighting]]:
    """Pairs of sightings that show one place, each in both orders."""
    for one in sightings:
        for other in sightings:
            (left, top, right, bottom), (a, b, c, d) = one.box_px, other.box_px
            common = max(min(right, c) - max(left, a), 0) * max(min(bottom, d) - max(top, b), 0)
            if one is not other and common >= SAME_PLACE * (
                (right - left) * (bottom - top) + (c - a) * (d - b) - common
            ):
                yield one, other


class _View:
    """One object as one camera sees it. Distances are of its middle from the camera, along the floor, m; bearings are
    in the body frame."""

    def __init__(self, known: ObjectSpec, camera: Camera, pose: FloatArray) -> None:
        self._camera, self._pose = camera, pose
        self._eye = pose[:3, 3]
        self._radius_m, self._height_m = known.planar_radius_m, known.size_m[2]
        self._sphere = known.shape == "sphere"

    def standing_m(self, bearing: float, away_m: float) -> FloatArray:
        """The centre of the object that stands there."""
        x, y = self._eye[0] + away_m * cos(bearing), self._eye[1] + away_m * sin(bearing)
        return np.array([x, y, self._height_m / 2])

    def along_m(self, ray: FloatArray, away_m: float) -> FloatArray:
        """The centre on a ray, wherever above the floor that is, as far from the camera as one that stands at this
        distance."""
        far_m = hypot(away_m, self._eye[2] - self._height_m / 2)
        return np.asarray(self._eye + ray / np.linalg.norm(ray) * far_m)

    def by_foot(self, bearing: float, row_px: float) -> float:
        """The distance at which the object's lowest row is this one; infinite where its foot would be beyond the
        horizon."""
        return self._solved(lambda away_m: -self._box(bearing, away_m)[3], -row_px)

    def by_top(self, bearing: float, row_px: float) -> float:
        """The distance at which the object's highest row is this one; infinite where the camera is not above it."""
        if self._eye[2] < self._height_m + LEAST_ABOVE_M:
            return inf
        return self._solved(lambda away_m: -self._box(bearing, away_m)[1], -row_px)

    def by_size(self, bearing: float, area_px: float) -> float:
        """The distance at which the object that stands there has so many pixels."""
        return self._solved(lambda away_m: -log(self.counted_px(bearing, away_m)), -log(max(area_px, 1.0)))

    def counted_px(self, bearing: float, away_m: float) -> float:
        """Number of pixels that are found of the whole object there."""
        u, v = self._outline(bearing, away_m)
        area = _hull_area(u, v)
        return max(area - min(2.0 * sqrt(area), 0.5 * area), 0.1)

    def foot_sigma_m(self, away_m: float) -> float:
        height_m = self._eye[2]
        angle = hypot(EDGE_PX / self._camera.fy, TILT_RAD)
        return hypot((height_m**2 + away_m**2) / height_m * angle, HEIGHT_SHARE * away_m)

    def top_sigma_m(self, away_m: float) -> float:
        above_m = self._eye[2] - self._height_m
        angle = hypot(EDGE_PX / self._camera.fy, TILT_RAD)
        share = hypot(HEIGHT_SHARE * self._eye[2], SIZE_SHARE * self._height_m) / above_m
        return hypot((above_m**2 + away_m**2) / above_m * angle, share * away_m)

    def edges_sigma_m(self, away_m: float) -> float:
        """Standard deviation of what foot and top differ by, which the camera's tilt and height shift alike."""
        height_m = self._eye[2]
        above_m = max(height_m - self._height_m, LEAST_ABOVE_M)
        rows = [(up_m**2 + away_m**2) / up_m for up_m in (height_m, above_m)]
        tilt_m = TILT_RAD * abs(rows[0] - rows[1])
        return hypot(EDGE_PX / self._camera.fy * hypot(*rows), SIZE_SHARE * self._height_m / above_m * away_m, tilt_m)

    def size_sigma_m(self, away_m: float) -> float:
        far_m, width_m = hypot(away_m, self._eye[2]), 2 * self._radius_m
        # All of the outline is off by the same, so the area by that times the circumference.
        edge = EDGE_PX * far_m / self._camera.fx * (width_m + self._height_m) / (width_m * self._height_m)
        return far_m * hypot(SIZE_SHARE, edge)

    def aspect_misfit(self, bearing: float, away_m: float, sighting: ImageSighting) -> float:
        """How badly the sides' ratio of the region's box fits."""
        left, top, right, bottom = self._box(bearing, away_m)
        own = sighting.box_px
        ratio = ((right - left) / (bottom - top)) / ((own[2] - own[0]) / (own[3] - own[1]))
        doubt = hypot(0.05, EDGE_PX / min(own[2] - own[0], own[3] - own[1]))
        return min(0.5 * (log(ratio) / doubt) ** 2, MOST_MISFIT)

    def width_misfit(self, bearing: float, away_m: float, width_px: float) -> float:
        """By how many standard deviations a region is wider than the object."""
        left, _, right, _ = self._box(bearing, away_m)
        return log(width_px / (right - left)) / hypot(0.05, 1.4 * EDGE_PX / width_px)

    def _box(self, bearing: float, away_m: float) -> tuple[float, float, float, float]:
        u, v = self._outline(bearing, away_m)
        return float(u.min()), float(v.min()), float(u.max()), float(v.max())

    def _outline(self, bearing: float, away_m: float) -> tuple[FloatArray, FloatArray]:
        """Points whose convex hull is the outline, px."""
        centre = self.standing_m(bearing, away_m)
        if self._sphere:
            towards = centre - self._eye
            far_m = float(np.linalg.norm(towards))
            towards /= far_m
            sine = min(self._radius_m / far_m, 0.99)
            beside = np.cross(towards, [0.0, 0.0, 1.0])
            beside /= np.linalg.norm(beside)
            above = np.cross(beside, towards)
            middle, rim_m = centre - towards * self._radius_m * sine, self._radius_m * sqrt(1 - sine**2)
            points = middle + rim_m * (np.outer(np.cos(CIRCLE), beside) + np.outer(np.sin(CIRCLE), above))
        else:
            rim = self._radius_m * np.stack([np.cos(CIRCLE), np.sin(CIRCLE)], axis=1) + centre[:2]
            points = np.concatenate([np.column_stack([rim, np.full(len(rim), z)]) for z in (0.0, self._height_m)])
        x, y, z = ((points - self._eye) @ self._pose[:3, :3]).T
        z = np.maximum(z, 0.02)
        return self._camera.cx + self._camera.fx * x / z, self._camera.cy + self._camera.fy * y / z

    def _solved(self, of_distance: Callable[[float], float], wanted: float) -> float:
        """The distance at which a value that grows with it is the wanted one; infinite where that is beyond all."""
        near_m, far_m = max(NEAREST_M, self._radius_m), FARTHEST_M
        if of_distance(far_m) < wanted:
            return inf
        # Bisection of the inverse distance, of which the picture's rows are nearly linear, then a secant.
        for _ in range(STEPS):
            middle = 2 / (1 / near_m + 1 / far_m)
            if of_distance(middle) < wanted:
                near_m = middle
            else:
                far_m = middle
        low, high = of_distance(near_m), of_distance(far_m)
        share = (wanted - low) / (high - low) if high > low else 0.5
        return float(1 / ((1 - share) / near_m + share / far_m))


def _hull_area(u: FloatArray, v: FloatArray) -> float:
    """Area of the convex hull of points (n,), px2."""
    points = np.stack([u, v], axis=1).astype(np.float32)
    return max(float(cv2.contourArea(cv2.convexHull(points))), 0.1)
