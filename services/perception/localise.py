"""Computes an object's position in the body frame from a sighting.

The visible surface is not the object: the visible centroid of a can is 19 to 33 mm in front of its axis, and moves
by 5 to 10 mm when a hand is in front of it. So the upright known shape is fitted to the visible surface points and
to the rays beside it that are known to be free. Hidden parts are no evidence and shift nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, log
from typing import NamedTuple

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.messages import Detection
from cocoro.objects import Catalogue, ObjectSpec
from cocoro.robot import Camera, Robot
from cocoro.units import Vec3
from services.perception.image import Evidence, ImageSighting, PixelBox
from services.perception.region import depth_doubt_m
from services.perception.shapes import counted_px, distance_from, reach_m, seen_area_m2, signed_distance

ITERATIONS = 12
SETTLED_M = 1e-4
MIN_SURFACE_POINTS = 12
PRIOR = np.eye(3) / 0.05**2
"""Inverse covariance of the first guess, 1/m2: it may be 5 cm off and decides only what the evidence leaves open."""
RAY_SAMPLES = 5
RAY_DOUBT_M, RAY_DOUBT_RAD = 0.001, 0.002
"""Standard deviation of the outline: a constant, and about a pixel at the object's distance."""
HUBER = 1.5
SAME_PLACE = 0.5
"""Overlap of two boxes (intersection over union) from which they show one place."""
UNDER_FLOOR_M, UNDER_FLOOR_PER_M = 0.03, 0.03
"""How far below the floor an object may seem to reach, as a constant and per distance, since the camera's mounting is
not known exactly."""
SIZE_DOUBT = 0.2
"""Standard deviation of the logarithm of the pixel count of an object that is not hidden."""


class Localiser:
    def __init__(self, robot: Robot, catalogue: Catalogue, occluded_share: float) -> None:
        self._catalogue = catalogue
        self._chain = robot.chain("camera")
        self._occluded_share = occluded_share
        self.joints = self._chain.joints
        """The head's joints, in the order of the angles for `camera_pose`."""

    def camera_pose(self, angles_rad: FloatArray) -> FloatArray:
        """The pose of the camera's frame (x right, y down, z forward) in the body frame, 4 x 4, m. `angles_rad` has
        shape (joints,)."""
        return self._chain.pose(dict(zip(self.joints, angles_rad, strict=True)))

    def locate(
        self, sightings: Sequence[ImageSighting], camera: Camera, angles_rad: FloatArray | None
    ) -> list[Detection]:
        """Detections with the centre's position in the body frame, or with a note why there is none. `angles_rad` has
        shape (joints,); None when the head angles are unknown.

        Of two objects with a common colour that are seen in one place, the one stays whose shape and size fit
        better.
        """
        pose = None if angles_rad is None else self.camera_pose(angles_rad)
        placed = [self._place(sighting, camera, pose) for sighting in sightings]
        return [
            one.detection
            for one in placed
            if not self._underground(one.detection) and not any(other.displaces(one) for other in placed)
        ]

    def _underground(self, detection: Detection) -> bool:
        """Whether the object would reach below the floor: then it is part of another, larger thing of its colour."""
        if detection.position_m is None or not detection.note:
            return False
        x, y, z = detection.position_m
        bottom_m = z - self._catalogue[detection.label].size_m[2] / 2
        return bottom_m < -UNDER_FLOOR_M - UNDER_FLOOR_PER_M * hypot(x, y)

    def _place(self, sighting: ImageSighting, camera: Camera, pose: FloatArray | None) -> _Placed:
        position: Vec3 | None = None
        fit: _ShapeFit | None = None
        note = ""
        if sighting.depth_m is None:
            note = "no depth"
        elif pose is None:
            note = "no head angles"
        else:
            known = self._catalogue[sighting.label]
            misfit = 0.0
            centre = first_guess(known, camera.ray(sighting.u_px, sighting.v_px) * sighting.depth_m, pose)
            evidence = sighting.evidence
            if evidence is not None and len(evidence.surface_m) >= MIN_SURFACE_POINTS:
                centre, misfit = fit_centre(known, evidence, pose, centre)
            position = float(centre[0]), float(centre[1]), float(centre[2])
            most_px = expected_area_px(known, centre, camera, pose)
            least_px = counted_px(most_px)
            if evidence is not None:
                whole = not (sighting.cut or sighting.hidden)
                size_misfit = _size_misfit(sighting.area_px, least_px, most_px) if whole else 0.0
                fit = _ShapeFit(misfit, size_misfit, evidence.count)
            occluded = sighting.area_px < self._occluded_share * least_px
            note = "cut" if sighting.cut else "occluded" if occluded else ""
        detection = Detection(
            label=sighting.label,
            u_px=sighting.u_px,
            v_px=sighting.v_px,
            area_px=sighting.area_px,
            box_px=sighting.box_px,
            depth_m=sighting.depth_m,
            position_m=position,
            note=note,
        )
        return _Placed(detection, fit)


class _ShapeFit(NamedTuple):
    misfit: float
    """Mean misfit per piece of evidence: half the squared residual over its standard deviation, by Huber's loss."""
    size_misfit: float
    """As `misfit`, for the pixel count."""
    pieces: int


class _Placed(NamedTuple):
    detection: Detection
    fit: _ShapeFit | None
    """None when no shape was fitted."""

    def displaces(self, other: _Placed) -> bool:
        """Whether this is another object in the same place that fits better."""
        if self is other or self.fit is None or other.fit is None:
            return False
        if _overlap(self.detection.box_px, other.detection.box_px) < SAME_PLACE:
            return False
        pieces = min(self.fit.pieces, other.fit.pieces)
        own, others = (fit.misfit * pieces + fit.size_misfit for fit in (self.fit, other.fit))
        return own < others


def _size_misfit(area_px: float, least_px: float, most_px: float) -> float:
    return 0.5 * (log(area_px / min(max(area_px, least_px), most_px)) / SIZE_DOUBT) ** 2


def _overlap(a: PixelBox, b: PixelBox) -> float:
    """Intersection over union."""
    across, down = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    common = max(across, 0) * max(down, 0)
    return common / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common)


def first_guess(known: ObjectSpec, surface_m: FloatArray, pose: FloatArray) -> FloatArray:
    """A first estimate of the object's centre in the body frame, m, shape (3,).

    `surface_m` is a point on its visible surface in the camera's frame, m, shape (3,); `pose` the camera's pose in
    the body frame, 4 x 4. The point is moved inwards by the radius: along the ray for a sphere, horizontally for
    upright shapes.
    """
    point: FloatArray = pose[:3, :3] @ surface_m + pose[:3, 3]
    inwards: FloatArray = point - pose[:3, 3]
    if known.shape != "sphere":
        inwards = inwards * np.array([1.0, 1.0, 0.0])
    return point + inwards * (known.planar_radius_m / max(float(np.linalg.norm(inwards)), 1e-9))


def fit_centre(known: ObjectSpec, evidence: Evidence, pose: FloatArray, start: FloatArray) -> tuple[FloatArray, float]:
    """The centre of the upright shape that fits the evidence best, body frame, m, shape (3,), and its mean misfit.

    `pose` is the camera's pose in the body frame, 4 x 4; `start` the first guess, m, shape (3,). Gauss-Newton on
    signed distances with Huber weights. Residuals: a surface point's distance from the shape, over its depth's
    standard deviation; the distance by which a ray of the outline misses the shape; the depth by which a free ray
    beside it enters the shape. The latter two are one-sided. Derived.
    """
    rotation, origin = pose[:3, :3], pose[:3, 3]
    guess = start - origin  # relative to the camera from here on, in the body's directions
    surface = evidence.surface_m @ rotation.T
    rays = _Rays(known, evidence, rotation, guess)
    seen, met = len(surface), len(surface) + len(evidence.outline)
    points = np.concatenate([surface, rays.directions])
    ray_doubt = RAY_DOUBT_M + RAY_DOUBT_RAD * float(guess @ rotation[:, 2])
    doubt = np.concatenate([depth_doubt_m(evidence.surface_m[:, 2]), np.full(len(points) - seen, ray_doubt)])
    centre = guess
    for _ in range(ITERATIONS):
        points[seen:] = rays.nearest(centre)
        distance, gradient = signed_distance(known, points - centre)
        np.maximum(distance[seen:met], 0.0, out=distance[seen:met])
        np.minimum(distance[met:], 0.0, out=distance[met:])
        residual = distance / doubt
        rows = gradient / -doubt[:, None]
        size = np.abs(residual)
        weight = HUBER / np.maximum(size, HUBER) * (residual != 0.0)
        weighted = rows * weight[:, None]
        move = np.linalg.solve(weighted.T @ rows + PRIOR, -weighted.T @ residual - PRIOR @ (centre - guess))
        centre = centre + move
        if float(np.abs(move).max()) < SETTLED_M:
            break
    misfit = float(np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER)).mean())
    wandered_m = float(np.linalg.norm(centre - guess))
    return (centre if wandered_m < 2 * reach_m(known) else guess) + origin, misfit


class _Rays:
    """The evidence's rays and the point of each that is nearest to the shape, relative to the camera, m.

    Along a ray the distance from a convex shape is convex: after one coarse search, a fine search around the last
    nearest point follows the centre as it moves.
    """

    def __init__(self, known: ObjectSpec, evidence: Evidence, rotation: FloatArray, guess: FloatArray) -> None:
        self._known = known
        self.directions: FloatArray = np.concatenate([evidence.outline, evidence.beside]) @ rotation.T
        self._free_to = np.concatenate([np.full(len(evidence.outline), np.inf), evidence.free_to_m])[:, None]
        self._every = np.arange(len(self.directions))
        length2 = (self.directions * self.directions).sum(axis=1)
        steps = np.linspace(-1.0, 1.0, RAY_SAMPLES) * (reach_m(known) / np.sqrt(length2))[:, None]
        self._depth = self._nearest_depth((self.directions @ guess / length2)[:, None] + steps, guess)
        self._fine_steps = steps * 1.5 / (RAY_SAMPLES - 1)

    def nearest(self, centre: FloatArray) -> FloatArray:
        """The point in each ray's free part that is nearest to the shape, or deepest in it, m, shape (n, 3). `centre`
        has shape (3,)."""
        self._depth = self._nearest_depth(self._depth[:, None] + self._fine_steps, centre)
        return self._depth[:, None] * self.directions

    def _nearest_depth(self, depths: FloatArray, centre: FloatArray) -> FloatArray:
        depths = np.minimum(depths, self._free_to)
        points = depths[:, :, None] * self.directions[:, None, :] - centre
        nearest: FloatArray = depths[self._every, distance_from(self._known, points).argmin(axis=1)]
        return nearest


def expected_area_px(known: ObjectSpec, centre: FloatArray, camera: Camera, pose: FloatArray) -> float:
    """Number of pixels that the whole object covers: the solid angle of its silhouette over that of a pixel. `centre`
    is in the body frame, m, shape (3,); `pose` the camera's, 4 x 4."""
    to_camera = pose[:3, 3] - centre
    distance = float(np.linalg.norm(to_camera))
    depth = float(-to_camera @ pose[:3, 2])
    if distance < 1e-6 or depth < 1e-6:
        return float("inf")
    sine = abs(float(to_camera[2])) / distance
    return seen_area_m2(known, sine) * camera.fx * camera.fy * distance / depth**3
