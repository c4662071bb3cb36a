"""Places known objects by colour alone, for a camera without depth.

An object is taken to stand on the floor the robot drives on. Two measurements tell its distance: the ray through its
foot, the lowest row of its region, meets the floor; and its outline is as large as the known object's there. Each has
a standard deviation: the first by the row's and the camera's tilt, which grows with the square of the distance, the
second by the outline's edge. Their weighted mean is the place, and goes out with its own standard deviation. Where they
contradict each other, the foot is hidden, or the object does not stand on the floor: then the outline alone counts, and
the detection is doubtful. (Derived; the ray's foot as in single-view metrology, Criminisi 2000.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from math import atan2, cos, hypot, inf, log, pi, sin, sqrt
from typing import NamedTuple

import cv2
import numpy as np

from cocoro.arrays import FloatArray
from cocoro.messages import Detection
from cocoro.objects import Catalogue, ObjectSpec
from cocoro.robot import Camera, Robot
from services.perception.image import ImageSighting
from services.perception.localise import SAME_PLACE, Localiser, detection_of

EDGE_PX = 0.7
"""Standard deviation of an edge of a region, px, at any resolution."""
TILT_RAD = 0.005
"""Standard deviation of the camera's tilt against the floor, which an own calibration of its mount reaches."""
HEIGHT_SHARE = 0.01
"""The same of the camera's height above the floor."""
SIZE_SHARE = 0.02
"""The same of the object's size and of the focal length."""
CONTRADICT = 3.0
"""Standard deviations between the two distances from which they contradict each other."""
LEAST_SHARE, MOST_SHARE = 0.3, 1.7
"""Shares of the pixels that the object would have where it stands. Outside of them, it is another thing."""
HIGHEST_M = 0.6
"""Greatest height of an object's middle that the robot can hold up."""
UNDER_FLOOR_M = 0.04
CIRCLE = np.linspace(0.0, 2 * pi, 24, endpoint=False)
STEPS = 12
NEAREST_M, FARTHEST_M = 0.05, 20.0


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

    def locate(
        self, sightings: Sequence[ImageSighting], camera: Camera, angles_rad: FloatArray | None
    ) -> list[Detection]:
        if angles_rad is None:
            return [detection_of(sighting, None, "no head angles") for sighting in sightings]
        pose = self.camera_pose(angles_rad)
        found = {
            sighting.label: placed
            for sighting in sightings
            if (placed := place(sighting, self._catalogue[sighting.label], camera, pose, self._occluded_share))
        }
        seen = [sighting for sighting in sightings if sighting.label in found]
        lost = {
            one.label
            for one, other in _together(seen)
            if found[one.label].misfit > found[other.label].misfit
        }  # fmt: skip
        detections = []
        for sighting in seen:
            placed = found[sighting.label]
            if sighting.label in lost or hypot(*placed.centre_m[:2]) > self._range_m:
                continue
            x, y, z = placed.centre_m.tolist()
            detections.append(detection_of(sighting, (x, y, z), placed.note, placed.sigma_m))
        return detections


def place(
    sighting: ImageSighting, known: ObjectSpec, camera: Camera, pose: FloatArray, occluded_share: float
) -> Placed | None:
    """Place an object. `pose`: the camera's in the body frame, 4 x 4. None where it is no such object."""
    view = _View(known, camera, pose)
    left, _, right, bottom = sighting.box_px
    cut_below, cut_beside = bottom >= camera.height - 1, left <= 1 or right >= camera.width - 1
    ray = pose[:3, :3] @ camera.ray(sighting.u_px, sighting.v_px)
    bearing = atan2(ray[1], ray[0])
    away_m = view.by_foot(bearing, bottom - 0.5) if not cut_below else inf
    # A region's outermost pixels are blended with the background on average half a pixel inside of the outline.
    size_m = view.by_size(bearing, float(sighting.area_px))
    stands = np.isfinite(away_m)
    if not stands and (cut_below and cut_beside):
        return None
    foot_sigma, size_sigma = view.foot_sigma_m(away_m) if stands else inf, view.size_sigma_m(size_m)
    share = sighting.area_px / view.counted_px(bearing, away_m) if stands else 1.0
    aspect = view.aspect_misfit(bearing, away_m if stands else size_m, sighting) if not sighting.cut else 0.0
    if stands and (sighting.cut or share < occluded_share):
        # Less than the whole object is seen, but its foot is.
        if share < LEAST_SHARE and not sighting.cut:
            return None
        note = "cut" if sighting.cut else "occluded"
        return Placed(view.standing_m(bearing, away_m), foot_sigma, note, aspect + abs(log(share)))
    apart = abs(away_m - size_m) / hypot(foot_sigma, size_sigma) if stands else inf
    if apart <= CONTRADICT:
        weights = np.array([foot_sigma, size_sigma]) ** -2.0
        fused_m = float(weights @ np.array([away_m, size_m]) / weights.sum())
        sigma_m = float(1 / sqrt(weights.sum()))
        return Placed(view.standing_m(bearing, fused_m), sigma_m, "", aspect + 0.5 * apart**2)
    centre = view.along_m(ray, size_m)
    reach = known.size_m[2] / 2
    if not reach - UNDER_FLOOR_M - 3 * size_sigma * abs(ray[2]) / float(np.linalg.norm(ray)) < centre[2] < HIGHEST_M:
        return None
    return Placed(centre, size_sigma, "cut" if sighting.cut else "occluded", aspect + 0.5 * CONTRADICT**2)


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

    def size_sigma_m(self, away_m: float) -> float:
        far_m = hypot(away_m, self._eye[2])
        side_px = self._camera.fx * sqrt(2 * self._radius_m * self._height_m) / far_m
        return far_m * hypot(SIZE_SHARE, EDGE_PX / side_px)

    def aspect_misfit(self, bearing: float, away_m: float, sighting: ImageSighting) -> float:
        """How badly the sides' ratio of the region's box fits."""
        left, top, right, bottom = self._box(bearing, away_m)
        own = sighting.box_px
        ratio = ((right - left) / (bottom - top)) / ((own[2] - own[0]) / (own[3] - own[1]))
        doubt = hypot(0.05, EDGE_PX / min(own[2] - own[0], own[3] - own[1]))
        return 0.5 * (log(ratio) / doubt) ** 2

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
            rim = self._radius_m * sqrt(1 - sine**2)
            middle = centre - towards * self._radius_m * sine
            points = middle + rim * (np.outer(np.cos(CIRCLE), beside) + np.outer(np.sin(CIRCLE), above))
        else:
            rim = self._radius_m * np.stack([np.cos(CIRCLE), np.sin(CIRCLE)], axis=1) + centre[:2]
            points = np.concatenate(
                [np.column_stack([rim, np.full(len(rim), z)]) for z in (0.0, self._height_m)]
            )  # fmt: skip
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
