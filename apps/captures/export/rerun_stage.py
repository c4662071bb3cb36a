"""The simulated robot and its scene in Rerun, seen from outside: meshes that move by the truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from apps.captures.export.geometry import quaternion
from cocoro.arrays import FloatArray
from cocoro.messages import Truth
from cocoro.units import Vec3
from sim.outside import OutsideStage, StagedBody
from sim.render.meshes import mesh, scale_of
from sim.render.room import FLOOR_RGB, OTHER_TILE_RGB, TILE_M

ROOT = "sim"
FLOOR_M = 4.0
"""Half width of the drawn floor."""
EYE_M: Vec3 = (-1.5, -1.9, 1.5)
"""The eye's place at the start, from the robot's starting place."""
LOOK_M: Vec3 = (0.5, 0.0, 0.25)
BACKGROUND = (206, 212, 218)


class StageLogger:
    """Logs a stage to a recording: its meshes once, and their places with each truth."""

    def __init__(self, rr: Any, recording: Any, stage: OutsideStage) -> None:
        self._rr = rr
        self._to = recording
        self._stage = stage
        recording.log(ROOT, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        centre = stage.scene.robot.position_m
        recording.log(f"{ROOT}/floor", _floor(rr, (centre[0], centre[1])), static=True)
        for body in stage.bodies:
            recording.log(self._path(body), _mesh(rr, body), static=True)

    def log(self, truth: Truth) -> None:
        """Raises ConfigError for a truth of another scene."""
        rr = self._rr
        for body, pose in zip(self._stage.bodies, self._stage.body_poses(truth), strict=True):
            turn = rr.Quaternion(xyzw=quaternion(pose[:3, :3]))
            self._to.log(self._path(body), rr.Transform3D(translation=pose[:3, 3], rotation=turn))

    def layout(self) -> Any:
        """The view from outside, which the mouse turns, beside the robot's picture, its beliefs and what it does."""
        blueprint = self._rr.blueprint
        to_world = self._stage.scene.to_world
        eye = blueprint.EyeControls3D(kind="Orbital", position=to_world(EYE_M), look_target=to_world(LOOK_M))
        return blueprint.Blueprint(
            blueprint.Horizontal(
                blueprint.Spatial3DView(
                    origin=f"/{ROOT}", name="from outside, in truth", eye_controls=eye, background=BACKGROUND
                ),
                blueprint.Vertical(
                    blueprint.Spatial2DView(origin="/world/body/camera/colour", name="what the robot sees"),
                    blueprint.Spatial3DView(origin="/world", name="what the robot believes"),
                    blueprint.TextLogView(origin="/log", name="what it does"),
                ),
                column_shares=(2, 1),
            ),
            collapse_panels=True,
        )

    @staticmethod
    def _path(body: StagedBody) -> str:
        return f"{ROOT}/{'robot' if body.on_robot else 'scene'}/{body.name}"


def _mesh(rr: Any, body: StagedBody) -> Any:
    """The visuals of a body as one mesh."""
    places, normals, colours = [], [], []
    for visual, offset in zip(body.visuals, body.offsets, strict=True):
        corners = mesh(visual.shape).astype(np.float64)
        scale = np.array(scale_of(visual))
        places.append((corners[:, :3] * scale) @ offset[:3, :3].T + offset[:3, 3])
        facing = (corners[:, 3:] / scale) @ offset[:3, :3].T
        normals.append(facing / np.linalg.norm(facing, axis=1, keepdims=True))
        colours.append(np.tile(_bytes(visual.rgb), (len(corners), 1)))
    return _triangles(rr, np.vstack(places), np.vstack(normals), np.vstack(colours))


def _floor(rr: Any, centre_m: tuple[float, float]) -> Any:
    """Tiles of two greys about a point."""
    half = round(FLOOR_M / TILE_M)
    x0, y0 = (round(value / TILE_M) for value in centre_m)
    places, colours = [], []
    for i in range(x0 - half, x0 + half):
        for j in range(y0 - half, y0 + half):
            square = np.array([(i, j), (i + 1, j), (i + 1, j + 1), (i, j), (i + 1, j + 1), (i, j + 1)]) * TILE_M
            places.append(np.column_stack([square, np.zeros(6)]))
            colours.append(np.tile(_bytes(FLOOR_RGB if (i + j) % 2 == 0 else OTHER_TILE_RGB), (6, 1)))
    corners = np.vstack(places)
    return _triangles(rr, corners, np.tile((0.0, 0.0, 1.0), (len(corners), 1)), np.vstack(colours))


def _triangles(rr: Any, places: FloatArray, normals: FloatArray, colours: Any) -> Any:
    return rr.Mesh3D(
        vertex_positions=places.astype(np.float32),
        vertex_normals=normals.astype(np.float32),
        vertex_colors=colours,
        triangle_indices=np.arange(len(places), dtype=np.uint32).reshape(-1, 3),
    )


def _bytes(rgb: Vec3) -> Any:
    return np.rint(255 * np.array(rgb)).astype(np.uint8)
