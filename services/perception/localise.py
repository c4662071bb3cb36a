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
from services.perception.shapes import reach_m, seen_area_m2, signed_distance
from services.perception.sighting import Evidence, Sighting

Array = NDArray[np.float64]

ITERATIONS = 12
SETTLED_M = 2e-5
MIN_SURFACE_POINTS = 12
PRIOR_M = 0.05
"""How far the first guess, the surface pushed inwards, may be off; it settles only what no evidence does."""
RAY_SAMPLES = 7
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
            elif sighting.area_px < self._occluded_share * expected_area_px(known, centre, camera, pose):
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

    Gauss-Newton on signed distances: surface points want distance 0, each against its depth's doubt and with
    Huber weights; a ray wants not to enter the shape before the depth it is free to. Derived.
    """
    rotation, origin = pose[:3, :3], pose[:3, 3]
    surface = evidence.surface_m @ rotation.T + origin
    surface_sigma = depth_doubt_m(evidence.surface_m[:, 2])
    directions = evidence.rays @ rotation.T
    ray_sigma = 0.002 + 0.003 * evidence.free_to_m.clip(0.0, 4.0)
    axis = rotation[:, 2]
    reach = reach_m(known)
    centre = start.copy()
    for _ in range(ITERATIONS):
        distance, gradient = signed_distance(known, surface - centre)
        residual = distance / surface_sigma
        weight = HUBER / np.maximum(np.abs(residual), HUBER)
        rows = -gradient / surface_sigma[:, None]
        hessian = (rows * weight[:, None]).T @ rows + np.eye(3) / PRIOR_M**2
        slope = rows.T @ (weight * residual) + (centre - start) / PRIOR_M**2

        inside, inside_gradient, which = _intrusions(known, centre, directions, evidence, origin, axis, reach)
        if len(inside):
            rows = -inside_gradient / ray_sigma[which, None]
            residual = inside / ray_sigma[which]
            weight = HUBER / np.maximum(np.abs(residual), HUBER)
            hessian += (rows * weight[:, None]).T @ rows
            slope += rows.T @ (weight * residual)

        move = -np.linalg.solve(hessian, slope)
        centre = centre + move
        if float(np.abs(move).max()) < SETTLED_M:
            break
    return centre


def _intrusions(
    known: KnownObject, centre: Array, directions: Array, evidence: Evidence, origin: Array, axis: Array, reach: float
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Of the free rays that enter the shape: how deep (negative, (m,)), the gradient there (m, 3), and which rays."""
    depth = float((centre - origin) @ axis)
    start, end = depth - reach, np.minimum(depth + reach, evidence.free_to_m)
    steps = np.linspace(0.0, 1.0, RAY_SAMPLES)
    along = start + (np.maximum(end, start) - start)[:, None] * steps
    points = origin + directions[:, None, :] * along[:, :, None] - centre
    distance, gradient = signed_distance(known, points.reshape(-1, 3))
    distance = distance.reshape(along.shape)
    deepest = distance.argmin(axis=1)
    every = np.arange(len(deepest))
    which = np.nonzero(distance[every, deepest] < 0)[0]
    chosen = gradient.reshape(*along.shape, 3)[which, deepest[which]]
    return distance[which, deepest[which]], chosen, which


def expected_area_px(known: KnownObject, centre: Array, camera: Camera, pose: Array) -> float:
    """Pixels that the whole object covers from here: its silhouette's solid angle, over that of a pixel."""
    to_camera = pose[:3, 3] - centre
    distance = float(np.linalg.norm(to_camera))
    depth = float(-to_camera @ pose[:3, 2])
    if distance < 1e-6 or depth < 1e-6:
        return float("inf")
    sine = abs(float(to_camera[2])) / distance
    return seen_area_m2(known, sine) * camera.fx * camera.fy * distance / depth**3
