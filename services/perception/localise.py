"""From what a detector saw to where the object stands in the body frame.

The visible surface is not the object: a can's visible centroid stands 19 to 33 mm before its axis, and moves by 5
to 10 mm when a hand comes before it. So the known shape is fitted, upright, to the surface points that are
visible, and to the rays beside it that are known to pass freely. Hidden parts say nothing and shift nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cocoro.messages import Detection, Vec3
from cocoro.objects import Catalogue, KnownObject
from cocoro.robot import Camera, Robot
from services.perception.region import depth_doubt_m
from services.perception.shapes import counted_px, distance_from, reach_m, seen_area_m2, signed_distance
from services.perception.sighting import Evidence, Sighting

Array = NDArray[np.float64]

ITERATIONS = 12
SETTLED_M = 2e-5
MIN_SURFACE_POINTS = 12
PRIOR_M = 0.05
"""How far the first guess, the surface pushed inwards, may be off; it settles only what no evidence does."""
RAY_SAMPLES = 5
RAY_DOUBT_M, RAY_DOUBT_RAD = 0.001, 0.002
"""How far the outline may be off: at a distance about a pixel."""
HUBER = 1.5


class Localiser:
    def __init__(self, robot: Robot, catalogue: Catalogue, occluded_share: float) -> None:
        self._catalogue = catalogue
        self._chain = robot.chain("camera")
        self._occluded_share = occluded_share
        self.joints = self._chain.joints
        """The head's joints, in the order of `camera_pose`'s angles."""

    def camera_pose(self, angles_rad: Array) -> Array:
        """4 x 4, camera frame (x right, y down, z forward) to body frame."""
        return self._chain.pose(dict(zip(self.joints, angles_rad, strict=True)))

    def locate(self, sighting: Sighting, camera: Camera, angles_rad: Array | None) -> Detection:
        """The detection as it is published: with the centre's position, or with a note of why there is none."""
        position: Vec3 | None = None
        note = ""
        if sighting.depth_m is None:
            note = "no depth"
        elif angles_rad is None:
            note = "no head angles"
        else:
            known = self._catalogue[sighting.label]
            pose = self.camera_pose(angles_rad)
            centre = first_guess(known, camera.ray(sighting.u_px, sighting.v_px) * sighting.depth_m, pose)
            if sighting.evidence is not None and len(sighting.evidence.surface_m) >= MIN_SURFACE_POINTS:
                centre = fit_centre(known, sighting.evidence, pose, centre)
            position = float(centre[0]), float(centre[1]), float(centre[2])
            if sighting.cut:
                note = "cut"
            elif sighting.area_px < self._occluded_share * counted_px(expected_area_px(known, centre, camera, pose)):
                note = "occluded"
        return Detection(
            label=sighting.label,
            u_px=sighting.u_px,
            v_px=sighting.v_px,
            area_px=sighting.area_px,
            box_px=sighting.box_px,
            depth_m=sighting.depth_m,
            position_m=position,
            note=note,
        )


def first_guess(known: KnownObject, surface_m: Array, pose: Array) -> Array:
    """The object's centre, body frame, from one point of its visible surface (camera frame), shape (3,).

    The point is pushed inwards by the radius: along the ray for a sphere, horizontally for what stands upright.
    """
    point: Array = pose[:3, :3] @ surface_m + pose[:3, 3]
    inwards: Array = point - pose[:3, 3]
    if known.shape != "sphere":
        inwards = inwards * np.array([1.0, 1.0, 0.0])
    return point + inwards * (known.planar_radius_m / max(float(np.linalg.norm(inwards)), 1e-9))


def fit_centre(known: KnownObject, evidence: Evidence, pose: Array, start: Array) -> Array:
    """The centre, body frame, of the upright shape that goes best with the evidence, shape (3,).

    Gauss-Newton on signed distances, with Huber weights: surface points want distance 0, each against its
    depth's doubt; a ray of the outline wants to meet the shape; a ray beside it wants not to enter the shape
    before the depth that it is free to. The latter two are one-sided. Derived.
    """
    rotation, origin = pose[:3, :3], pose[:3, 3]
    surface = evidence.surface_m @ rotation.T + origin
    surface_sigma = depth_doubt_m(evidence.surface_m[:, 2])
    rays = _Rays(known, evidence, rotation, origin, start)
    ray_sigma = RAY_DOUBT_M + RAY_DOUBT_RAD * float((start - origin) @ rotation[:, 2])
    centre = start.copy()
    for _ in range(ITERATIONS):
        distance, gradient = signed_distance(known, surface - centre)
        ray_distance, ray_gradient = rays.misses(centre)
        residual = np.concatenate([distance / surface_sigma, ray_distance / ray_sigma])
        rows = np.concatenate([gradient / -surface_sigma[:, None], ray_gradient / -ray_sigma])
        weighted = rows * (HUBER / np.maximum(np.abs(residual), HUBER))[:, None]
        move = np.linalg.solve(
            weighted.T @ rows + np.eye(3) / PRIOR_M**2, -weighted.T @ residual - (centre - start) / PRIOR_M**2
        )
        centre = centre + move
        if float(np.abs(move).max()) < SETTLED_M:
            break
    return centre


class _Rays:
    """The evidence's rays, and by how much each contradicts a centre of the shape.

    Along a ray the distance from a convex shape is convex: a coarse look once, then a fine one around the place
    that was nearest before, which follows the centre as it moves.
    """

    def __init__(self, known: KnownObject, evidence: Evidence, rotation: Array, origin: Array, start: Array) -> None:
        self._known = known
        self._origin = origin
        self._directions = np.concatenate([evidence.outline, evidence.beside]) @ rotation.T
        self._meeting = len(evidence.outline)
        self._free_to = np.concatenate([np.full(self._meeting, np.inf), evidence.free_to_m])
        length = np.linalg.norm(self._directions, axis=1)
        steps = np.linspace(-1.0, 1.0, RAY_SAMPLES) * reach_m(known) / length[:, None]
        self._depth = self._nearest((self._directions @ (start - origin) / length**2)[:, None] + steps, start - origin)
        self._fine_steps = steps * 1.5 / (RAY_SAMPLES - 1)

    def misses(self, centre: Array) -> tuple[Array, Array]:
        """For each ray a distance (n,) and its gradient (n, 3): by how much a ray of the outline passes the shape, or
        (negative) how deep a ray beside enters it; zero where a ray agrees."""
        to_centre = centre - self._origin
        self._depth = self._nearest(self._depth[:, None] + self._fine_steps, to_centre)
        distance, gradient = signed_distance(self._known, self._depth[:, None] * self._directions - to_centre)
        agrees = distance > 0.0
        agrees[: self._meeting] ^= True
        distance[agrees] = 0.0
        gradient[agrees] = 0.0
        return distance, gradient

    def _nearest(self, depths: Array, to_centre: Array) -> Array:
        """Of the points at these depths (n, samples) on each ray the nearest one's depth, (n,)."""
        depths = np.minimum(depths, self._free_to[:, None])
        points = depths[:, :, None] * self._directions[:, None, :] - to_centre
        nearest: Array = depths[np.arange(len(depths)), distance_from(self._known, points).argmin(axis=1)]
        return nearest


def expected_area_px(known: KnownObject, centre: Array, camera: Camera, pose: Array) -> float:
    """Pixels that the whole object covers from here: its silhouette's solid angle, over that of a pixel."""
    to_camera = pose[:3, 3] - centre
    distance = float(np.linalg.norm(to_camera))
    depth = float(-to_camera @ pose[:3, 2])
    if distance < 1e-6 or depth < 1e-6:
        return float("inf")
    sine = abs(float(to_camera[2])) / distance
    return seen_area_m2(known, sine) * camera.fx * camera.fy * distance / depth**3
