"""Computes objects' positions in the body frame from sightings.

The visible surface is not the object: the visible centroid of a can is 19 to 33 mm in front of its axis, and moves
by 5 to 10 mm when a hand is in front of it. So the upright known shape is fitted to the visible surface points and
to the rays beside it that are known to be free. Hidden parts are no evidence and shift nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.messages import Detection
from cocoro.objects import Catalogue
from cocoro.robot import Camera, Robot
from cocoro.units import Vec3
from services.perception.fit import fit_centres
from services.perception.image import ImageSighting
from services.perception.shapes import Shapes, counted_px

MIN_SURFACE_POINTS = 12
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
        self._shapes = Shapes(catalogue.objects)
        self._numbers = {label: number for number, label in enumerate(catalogue.labels)}
        self._chain = robot.camera_chain
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
        placed: dict[str, Detection | None] = {}
        if angles_rad is not None:
            seen = [sighting for sighting in sightings if sighting.depth_m is not None]
            placed = self._place(seen, camera, self.camera_pose(angles_rad)) if seen else {}
        found = []
        for sighting in sightings:
            if sighting.depth_m is None:
                found.append(detection_of(sighting, None, "no depth"))
            elif angles_rad is None:
                found.append(detection_of(sighting, None, "no head angles"))
            else:
                detection = placed[sighting.label]
                if detection is not None:
                    found.append(detection)
        return found

    def _place(
        self, sightings: Sequence[ImageSighting], camera: Camera, pose: FloatArray
    ) -> dict[str, Detection | None]:
        """The detections of sightings with depth, by their labels; None for what is no such object."""
        shapes = self._shapes.of([self._numbers[sighting.label] for sighting in sightings])
        u, v, depth, area_px = np.array(
            [(sighting.u_px, sighting.v_px, sighting.depth_m, sighting.area_px) for sighting in sightings]
        ).T
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=1)
        centres = first_guesses(shapes, rays * depth[:, None], pose)
        evidence = [sighting.evidence for sighting in sightings]
        misfit = np.zeros(len(sightings))
        pieces = np.array([some.frame.count[some.number] if some else 0 for some in evidence])
        fitted = [
            row
            for row, some in enumerate(evidence)
            if some and some.frame.surface_count[some.number] >= MIN_SURFACE_POINTS
        ]
        some_evidence = next((some.frame for some in evidence if some), None)
        if fitted and some_evidence is not None:
            mine = some_evidence.of([some.number for row in fitted if (some := evidence[row])])
            centres[fitted], misfit[fitted] = fit_centres(shapes.of(fitted), mine, pose, centres[fitted])
        most_px = expected_areas_px(shapes, centres, camera, pose)
        least_px = counted_px(most_px)
        occluded = area_px < self._occluded_share * least_px
        whole = np.array([not (sighting.cut or sighting.hidden) for sighting in sightings])
        size_misfit = 0.5 * (np.log(area_px / np.clip(area_px, least_px, most_px)) / SIZE_DOUBT) ** 2 * whole
        displaced = _displaced(sightings, misfit, size_misfit, pieces)
        found: dict[str, Detection | None] = {}
        rows = zip(sightings, centres.tolist(), occluded.tolist(), displaced, strict=True)
        for sighting, (x, y, z), hidden, lost in rows:
            note = "cut" if sighting.cut else "occluded" if hidden else ""
            gone = lost or (bool(note) and self._underground(sighting.label, (x, y, z)))
            found[sighting.label] = None if gone else detection_of(sighting, (x, y, z), note)
        return found

    def _underground(self, label: str, position_m: Vec3) -> bool:
        """Whether the object would reach below the floor: then what is seen is part of another, larger thing of its
        colour."""
        x, y, z = position_m
        bottom_m = z - self._catalogue[label].size_m[2] / 2
        return bottom_m < -UNDER_FLOOR_M - UNDER_FLOOR_PER_M * hypot(x, y)


def detection_of(
    sighting: ImageSighting, position_m: Vec3 | None, note: str, sigma_m: float | None = None
) -> Detection:
    return Detection(
        label=sighting.label,
        u_px=sighting.u_px,
        v_px=sighting.v_px,
        area_px=sighting.area_px,
        box_px=sighting.box_px,
        depth_m=sighting.depth_m,
        position_m=position_m,
        note=note,
        sigma_m=sigma_m,
    )


def _displaced(
    sightings: Sequence[ImageSighting], misfit: FloatArray, size_misfit: FloatArray, pieces: FloatArray
) -> list[bool]:
    """For each sighting whether another one with evidence shows the same place and fits better, by the mean misfit per
    piece of evidence (n,) (half the squared residual over its standard deviation, by Huber's loss), that of the pixel
    count (n,), and the number of pieces (n,)."""
    left, top, right, bottom = np.array([sighting.box_px for sighting in sightings]).T
    across = np.minimum.outer(right, right) - np.maximum.outer(left, left)
    down = np.minimum.outer(bottom, bottom) - np.maximum.outer(top, top)
    common = np.maximum(across, 0) * np.maximum(down, 0)
    areas = (right - left) * (bottom - top)
    together = common >= SAME_PLACE * (np.add.outer(areas, areas) - common)
    lost = [False] * len(sightings)
    if np.count_nonzero(together) == len(sightings):  # each with itself
        return lost
    for one, other in np.argwhere(np.triu(together, 1)).tolist():
        if pieces[one] and pieces[other]:
            fewer = min(pieces[one], pieces[other])
            left, right = (misfit[i] * fewer + size_misfit[i] for i in (one, other))
            lost[one] |= bool(right < left)
            lost[other] |= bool(left < right)
    return lost


def first_guesses(shapes: Shapes, surface_m: FloatArray, pose: FloatArray) -> FloatArray:
    """First estimates of the objects' centres in the body frame, m, shape (n, 3).

    `surface_m` is a point on the visible surface of each in the camera's frame, m, shape (n, 3); `pose` the camera's
    pose in the body frame, 4 x 4. The point is moved inwards by the radius: along the ray for a sphere, horizontally
    for upright shapes.
    """
    inwards = surface_m @ pose[:3, :3].T
    points: FloatArray = inwards + pose[:3, 3]
    inwards[:, 2] *= shapes.sphere
    length = np.maximum(np.sqrt((inwards * inwards).sum(axis=1)), 1e-9)
    points += inwards * (shapes.radius_m / length)[:, None]
    return points


def expected_areas_px(shapes: Shapes, centres: FloatArray, camera: Camera, pose: FloatArray) -> FloatArray:
    """Number of pixels that each whole object covers, (n,): the solid angle of its silhouette over that of a pixel.
    `centres` are in the body frame, m, shape (n, 3); `pose` is the camera's, 4 x 4."""
    to_camera = pose[:3, 3] - centres
    distance = np.sqrt((to_camera * to_camera).sum(axis=1))
    depth = -to_camera @ pose[:3, 2]
    here = (distance < 1e-6) | (depth < 1e-6)
    sine = np.abs(to_camera[:, 2]) / np.where(here, 1.0, distance)
    solid = shapes.seen_area_m2(np.minimum(sine, 1.0)) * camera.fx * camera.fy * distance
    areas: FloatArray = np.where(here, np.inf, solid / np.where(here, 1.0, depth) ** 3)
    return areas
