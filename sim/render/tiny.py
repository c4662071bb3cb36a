"""The fallback renderer: PyBullet's TinyRenderer on the processor, about 100 ms per view at 640 x 480.

It draws from a separate PyBullet client that holds only the visuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy  # loads its parts when they are needed: `scipy.spatial` takes 16 MB, and OpenGL does without

from cocoro.arrays import BoolArray, Float32Array, FloatArray, ImageArray
from cocoro.robot import Camera
from sim.bullet import Bullet
from sim.render.interface import Images, Lighting, Visual
from sim.render.room import FLOOR_RGB, HALF_WIDTH_M, walls
from sim.render.views import PROJECTOR_BIAS_PER_M, lamp_tint, projection, projector_camera, rigid_inverse

NEAR_M, FAR_M = 0.05, 30.0
"""Closer together than the fast renderer's, since depth is computed from a 32-bit float with a loss of precision."""
FLOOR_THICK_M = 0.02
_SAMPLE_OFFSET_PX = (-0.5, 0.5)
"""TinyRenderer samples a pixel at its left lower corner, not at its centre (measured on a plane and a can)."""
_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the camera's frame (y down, z forward) to OpenGL's (y up, z backward)."""


class TinyRenderer:
    """See `interface.Renderer`. The floor is plain, the lamp casts no shadows, and the depth has holes where the
    projector's light grazes a surface."""

    name = "tiny"

    def __init__(self, visuals: Sequence[Visual], camera: Camera) -> None:
        self.camera = camera
        self._bullet = bullet = Bullet()
        self._bodies = [self._body(self._shape(visual), visual.rgb) for visual in visuals]
        side = 2 * HALF_WIDTH_M
        floor = Visual("floor", "box", (side, side, FLOOR_THICK_M), FLOOR_RGB)
        for visual, centre in ((floor, (0.0, 0.0, -FLOOR_THICK_M / 2)), *walls()):
            body = self._body(self._shape(visual), visual.rgb)
            bullet.resetBasePositionAndOrientation(body, centre, (0, 0, 0, 1))

    def _shape(self, visual: Visual) -> dict[str, Any]:
        match visual.shape, visual.size_m:
            case "box", (x, y, z):
                return {"shapeType": self._bullet.GEOM_BOX, "halfExtents": [x / 2, y / 2, z / 2]}
            case "cylinder", (radius, height):
                return {"shapeType": self._bullet.GEOM_CYLINDER, "radius": radius, "length": height}
            case "sphere", (radius,):
                return {"shapeType": self._bullet.GEOM_SPHERE, "radius": radius}
        raise ValueError(f"visual {visual.name!r}: a {visual.shape} cannot have the size {visual.size_m}")

    def _body(self, shape: dict[str, Any], rgb: tuple[float, float, float]) -> int:
        index = self._bullet.createVisualShape(**shape, rgbaColor=(*rgb, 1.0), specularColor=(0, 0, 0))
        body: int = self._bullet.createMultiBody(baseMass=0.0, baseVisualShapeIndex=index)
        return body

    def render(
        self,
        poses: FloatArray,
        camera_pose: FloatArray,
        depth_camera_pose: FloatArray,
        light: Lighting,
        projector_pose: FloatArray | None = None,
    ) -> Images:
        quaternions = scipy.spatial.transform.Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        for body, pose, quaternion in zip(self._bodies, poses, quaternions, strict=True):
            self._bullet.resetBasePositionAndOrientation(body, pose[:3, 3], quaternion)
        colour, _ = self._view(self.camera, camera_pose, light)
        _, depth = self._view(self.camera, depth_camera_pose, light)
        if projector_pose is not None:
            baseline_m = float((depth_camera_pose[:3, :3].T @ (projector_pose[:3, 3] - depth_camera_pose[:3, 3]))[0])
            wide = projector_camera(self.camera, abs(baseline_m))
            _, lit = self._view(wide, projector_pose, light)
            depth[_shaded(depth, self.camera, lit, wide, baseline_m)] *= -1
        return Images(colour, depth)

    def _view(self, camera: Camera, pose: FloatArray, light: Lighting) -> tuple[ImageArray, Float32Array]:
        view = _TO_OPENGL @ rigid_inverse(pose)
        camera = replace(camera, cx=camera.cx + _SAMPLE_OFFSET_PX[0], cy=camera.cy + _SAMPLE_OFFSET_PX[1])
        flip_rows = np.diag([1.0, -1.0, 1.0, 1.0])
        project = flip_rows @ projection(camera, NEAR_M, FAR_M) @ _TO_OPENGL
        _, _, rgba, z, _ = self._bullet.getCameraImage(
            camera.width,
            camera.height,
            view.T.ravel().tolist(),
            project.T.ravel().tolist(),
            lightDirection=[-v for v in light.direction],
            lightColor=(1.0, 1.0, 1.0),
            lightDistance=10.0,
            shadow=0,
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.diffuse,
            lightSpecularCoeff=0.0,
            renderer=self._bullet.ER_TINY_RENDERER,
            flags=self._bullet.ER_NO_SEGMENTATION_MASK,
        )
        z = np.asarray(z, np.float32).reshape(camera.height, camera.width)
        depth = FAR_M * NEAR_M / (FAR_M - (FAR_M - NEAR_M) * z)
        depth[depth > 0.99 * FAR_M] = np.inf
        # The tint is applied here, since TinyRenderer's light colour would leave the ambient share white.
        rgb = np.asarray(rgba, np.uint8).reshape(camera.height, camera.width, 4)[..., :3]
        return np.rint(rgb * lamp_tint(light.temperature_k)).astype(np.uint8), depth

    def close(self) -> None:
        self._bullet.close()


def _shaded(
    depth_m: Float32Array, camera: Camera, lit_m: Float32Array, projector: Camera, baseline_m: float
) -> BoolArray:
    """The pixels of the depth picture `depth_m` (height, width) that the projector does not reach, (height, width).

    `lit_m` is the depth picture from the projector, which stands `baseline_m` to the right and looks the same way: a
    point is in the same row of both pictures, and further left in the projector's by its disparity.
    """
    columns = np.arange(camera.width, dtype=np.float32) - camera.cx + projector.cx
    u = np.rint(columns - camera.fx * baseline_m / depth_m).astype(np.intp)
    inside = (u >= 0) & (u < projector.width)
    reached = np.take_along_axis(lit_m, np.clip(u, 0, projector.width - 1), axis=1)
    shaded: BoolArray = inside & (1 / reached - 1 / depth_m > PROJECTOR_BIAS_PER_M)
    return shaded
