"""From what a detector saw to where the object stands in the body frame.

The visible surface is not the object: a can's visible centroid stands 19 to 33 mm before its axis, and moves by 5
to 10 mm when a hand comes before it. So the known shape is fitted, upright, to the surface points that are
visible, and to the rays beside it that are known to pass freely. Hidden parts say nothing and shift nothing.
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
from services.perception.image import PixelBox
from services.perception.region import depth_doubt_m
from services.perception.shapes import counted_px, distance_from, reach_m, seen_area_m2, signed_distance
from services.perception.sighting import Evidence, ImageSighting

ITERATIONS = 12
SETTLED_M = 1e-4
MIN_SURFACE_POINTS = 12
PRIOR = np.eye(3) / 0.05**2
"""The first guess, the surface pushed inwards, may be 5 cm off: it settles only what no evidence does."""
RAY_SAMPLES = 5
RAY_DOUBT_M, RAY_DOUBT_RAD = 0.001, 0.002
"""How far the outline may be off: at a distance about a pixel."""
HUBER = 1.5
SAME_PLACE = 0.5
"""Overlap of two boxes, common area over area together."""
UNDER_FLOOR_M, UNDER_FLOOR_PER_M = 0.03, 0.03
"""How far under the floor something may seem to reach: where it is, and more at a distance, since the camera's
mounting is not known exactly."""
SIZE_DOUBT = 0.2
"""How far the number of pixels may be off, as a share (its logarithm), where nothing hides any."""


class Localiser:
    def __init__(self, robot: Robot, catalogue: Catalogue, occluded_share: float) -> None:
        self._catalogue = catalogue
        self._chain = robot.chain("camera")
        self._occluded_share = occluded_share
        self.joints = self._chain.joints
        """The head's joints, in the order of `camera_pose`'s angles."""

    def camera_pose(self, angles_rad: FloatArray) -> FloatArray:
        """4 x 4, camera frame (x right, y down, z forward) to body frame."""
        return self._chain.pose(dict(zip(self.joints, angles_rad, strict=True)))

    def locate(
        self, sightings: Sequence[ImageSighting], camera: Camera, angles_rad: FloatArray | None
    ) -> list[Detection]:
        """The detections as they are published: with the centre's position, or with a note of why there is none.

        Where two objects share a colour, both may have been sighted in one place: the one stays whose shape and size
        go better with it.
        """
        pose = None if angles_rad is None else self.camera_pose(angles_rad)
        placed = [self._place(sighting, camera, pose) for sighting in sightings]
        return [
            one.detection
            for one in placed
            if not self._underground(one.detection) and not any(other.displaces(one) for other in placed)
        ]

    def _underground(self, detection: Detection) -> bool:
        """It is a part of something that is taken for the part of another thing, which would reach into the floor."""
        if detection.position_m is None or not detection.note:
            return False
        x, y, z = detection.position_m
        bottom_m = z - self._catalogue[detection.label].size_m[2] / 2
        return bottom_m < -UNDER_FLOOR_M - UNDER_FLOOR_PER_M * hypot(x, y)

    def _place(self, sighting: ImageSighting, camera: Camera, pose: FloatArray | None) -> _Placed:
        position: Vec3 | None = None
        fit: _Fit | None = None
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
                fit = _Fit(misfit, size_misfit, evidence.count)
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


class _Fit(NamedTuple):
    misfit: float
    """Of one piece of evidence, in the mean: half the squared residual against its own doubt, Huber's beyond some."""
    size_misfit: float
    """Of the number of pixels, likewise."""
    pieces: int


class _Placed(NamedTuple):
    detection: Detection
    fit: _Fit | None
    """None where no shape was fitted."""

    def displaces(self, other: _Placed) -> bool:
        """It is another object in the same place, and goes better with what is seen there."""
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
    """What two boxes have in common, as a share of what they cover together."""
    across, down = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    common = max(across, 0) * max(down, 0)
    return common / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common)


def first_guess(known: ObjectSpec, surface_m: FloatArray, pose: FloatArray) -> FloatArray:
    """The object's centre, body frame, from one point of its visible surface (camera frame), shape (3,).

    The point is pushed inwards by the radius: along the ray for a sphere, horizontally for what stands upright.
    """
    point: FloatArray = pose[:3, :3] @ surface_m + pose[:3, 3]
    inwards: FloatArray = point - pose[:3, 3]
    if known.shape != "sphere":
        inwards = inwards * np.array([1.0, 1.0, 0.0])
    return point + inwards * (known.planar_radius_m / max(float(np.linalg.norm(inwards)), 1e-9))


def fit_centre(known: ObjectSpec, evidence: Evidence, pose: FloatArray, start: FloatArray) -> tuple[FloatArray, float]:
    """The centre, body frame, of the upright shape that goes best with the evidence, shape (3,), and its misfit.

    Gauss-Newton on signed distances, with Huber weights: surface points want distance 0, each against its
    depth's doubt; a ray of the outline wants to meet the shape; a ray beside it wants not to enter the shape
    before the depth that it is free to. The latter two are one-sided. Derived.
    """
    rotation, origin = pose[:3, :3], pose[:3, 3]
    guess = start - origin  # from here on everything is relative to the camera, in the body's directions
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
    """The evidence's rays, and where each comes nearest to the shape. Points are relative to the camera.

    Along a ray the distance from a convex shape is convex: a coarse look once, then a fine one around the place
    that was nearest before, which follows the centre as it moves.
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
        """The point of each ray, of its free part, that is nearest to (or deepest in) the shape there, (n, 3)."""
        self._depth = self._nearest_depth(self._depth[:, None] + self._fine_steps, centre)
        return self._depth[:, None] * self.directions

    def _nearest_depth(self, depths: FloatArray, centre: FloatArray) -> FloatArray:
        depths = np.minimum(depths, self._free_to)
        points = depths[:, :, None] * self.directions[:, None, :] - centre
        nearest: FloatArray = depths[self._every, distance_from(self._known, points).argmin(axis=1)]
        return nearest


def expected_area_px(known: ObjectSpec, centre: FloatArray, camera: Camera, pose: FloatArray) -> float:
    """Pixels that the whole object covers from here: its silhouette's solid angle, over that of a pixel."""
    to_camera = pose[:3, 3] - centre
    distance = float(np.linalg.norm(to_camera))
    depth = float(-to_camera @ pose[:3, 2])
    if distance < 1e-6 or depth < 1e-6:
        return float("inf")
    sine = abs(float(to_camera[2])) / distance
    return seen_area_m2(known, sine) * camera.fx * camera.fy * distance / depth**3
