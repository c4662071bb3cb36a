"""The fast renderer: OpenGL 3.3 through moderngl on EGL, without a display. Without a graphics card Mesa draws on the
processor (llvmpipe).

A frame takes four passes: the lamp's shadow map, the colour picture, the projector's shadow map (for real sensors), and
the depth picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any, NamedTuple, Protocol

import cv2
import moderngl
import numpy as np
from numpy.typing import ArrayLike

from cocoro.arrays import Float32Array, FloatArray, ImageArray
from cocoro.robot import Camera
from sim.render.interface import Images, Lighting, Visual
from sim.render.meshes import floor_mesh, instanced_meshes, wall_mesh
from sim.render.room import FLOOR_RGB, HALF_WIDTH_M, OTHER_TILE_RGB, TILE_M, WALL_PARTS_M, nearest_wall_m
from sim.render.views import (
    PROJECTOR_BIAS_PER_M,
    PROJECTOR_NEAR_M,
    lamp_tint,
    lamp_view,
    projection,
    projector_camera,
    rigid_inverse,
)

LIBRARIES = {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
"""The libraries by their run-time names, which exist without development packages."""
LAMP_TEXELS = 512
LAMP_HALF_WIDTH_M = 2.0
"""Half width of the cube in front of the camera that has shadows, 8 mm per texel. Everything outside is lit."""
LAMP_AHEAD_M = 1.2
PROJECTOR_REACH_M = 4.0
"""Depth beyond which the depth camera does not see the projector's light, nor its shadows on the room's walls. The
Kinect's range ends before."""


class _Owned(Protocol):
    def release(self) -> Any: ...


class _ShadowMap(NamedTuple):
    depth: moderngl.Texture
    target: moderngl.Framebuffer


class GlRenderer:
    """See `interface.Renderer`. All instances in a process must be used in the thread that made the first one.

    Raises moderngl's own exceptions when there is no OpenGL.
    """

    name = "moderngl"

    def __init__(self, visuals: Sequence[Visual], camera: Camera) -> None:
        self.camera = camera
        self._ctx = ctx = context()
        self._owned: list[_Owned] = []
        self._objects = instanced_meshes(ctx, visuals)
        self._floor, self._walls = floor_mesh(ctx), wall_mesh(ctx)
        self._owned += [*self._objects, self._floor, self._walls]

        self._lambert = self._program("object", "object")
        self._tiles = self._program("floor", "floor")
        self._unshaded = self._program("far", "far")
        self._metres = self._program("depth", "depth")
        self._plain_metres = self._program("shadow", "plain_depth")
        self._shade = self._program("shadow", "shadow")
        _set(self._tiles, rgb=FLOOR_RGB, other_rgb=OTHER_TILE_RGB, tile_m=TILE_M)

        size = (camera.width, camera.height)
        self._colour_target = self._target(ctx.renderbuffer(size, 4), ctx.depth_renderbuffer(size))
        self._depth_target = self._target(ctx.renderbuffer(size, 1, dtype="f4"), ctx.depth_renderbuffer(size))
        self._lamp_map = self._shadow_map((LAMP_TEXELS, LAMP_TEXELS), moderngl.LINEAR)
        self._projector_map: _ShadowMap | None = None
        self._projection = projection(camera)
        self._rgba = np.empty((camera.height, camera.width, 4), np.uint8)
        self._rgb = np.empty((camera.height, camera.width, 3), np.uint8)
        self._depth_m = np.empty((camera.height, camera.width), np.float32)

    def render(
        self,
        poses: FloatArray,
        camera_pose: FloatArray,
        depth_camera_pose: FloatArray,
        light: Lighting,
        projector_pose: FloatArray | None = None,
    ) -> Images:
        self.place(poses)
        self.draw(camera_pose, light, _floor_ahead(camera_pose))
        self.draw_depth(depth_camera_pose, projector_pose)
        return Images(self.picture(), self.metres())

    # --- a colour picture alone -------------------------------------------------------------------

    def place(self, poses: FloatArray) -> None:
        """Set the world poses of the visuals, (n, 4, 4), for the drawings that follow."""
        self._ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        placed = poses.astype(np.float32)
        for mesh in self._objects:
            mesh.place(placed)

    def draw(
        self,
        camera_pose: FloatArray,
        light: Lighting,
        shadows_about_m: FloatArray,
        shift_px: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Draw the colour picture, moved by a part of a pixel, with shadows around a point, (3,)."""
        direction = np.asarray(light.direction) / np.linalg.norm(light.direction)
        lamp = lamp_view(direction, shadows_about_m, LAMP_HALF_WIDTH_M, LAMP_TEXELS)
        # The lamp's map holds the faces away from the lamp, so that a lit surface never shades itself.
        self._draw_shadow_map(self._lamp_map, lamp, front_face="ccw")

        shift = np.eye(4)
        shift[:2, 3] = 2 * shift_px[0] / self.camera.width, 2 * shift_px[1] / self.camera.height
        view = shift @ self._projection @ rigid_inverse(camera_pose)
        tint = lamp_tint(light.temperature_k)
        ambient, diffuse = light.ambient * tint, light.diffuse * tint
        on_floor = max(-direction[2], 0.0)
        _set(self._lambert, view=view, lamp=lamp, to_lamp=-direction, ambient=ambient, diffuse=diffuse)
        _set(self._tiles, view=view, lamp=lamp, ambient=ambient, diffuse=diffuse * on_floor)
        _set(self._unshaded, view=view, to_lamp=-direction, ambient=ambient, diffuse=diffuse)
        self._lamp_map.depth.use(0)
        self._colour_target.use()
        self._colour_target.clear()
        for mesh in self._objects:
            mesh.draw(self._lambert)
        self._walls.draw(self._lambert if _reaches_walls(direction, shadows_about_m) else self._unshaded)
        self._floor.draw(self._tiles)

    def picture(self) -> ImageArray:
        """The newest colour picture, RGB, (height, width, 3), which the next one overwrites."""
        self._colour_target.read_into(self._rgba, components=4)
        cv2.cvtColor(self._rgba, cv2.COLOR_RGBA2RGB, dst=self._rgb)
        return self._rgb

    # --- a depth picture alone --------------------------------------------------------------------

    def draw_depth(self, pose: FloatArray, projector_pose: FloatArray | None) -> None:
        """Draw the depth picture; see `render`."""
        view = self._projection @ rigid_inverse(pose)
        _set(self._plain_metres, view=view)
        lit = lit_walls = self._plain_metres
        if projector_pose is not None:
            self._draw_projector_map(projector_pose, float(np.linalg.norm(projector_pose[:3, 3] - pose[:3, 3])))
            _set(self._metres, view=view)
            lit = self._metres
            if nearest_wall_m(self.camera, pose) < PROJECTOR_REACH_M:
                lit_walls = lit
        self._depth_target.use()
        self._depth_target.clear(red=np.inf)
        for mesh in (*self._objects, self._floor):
            mesh.draw(lit)
        self._walls.draw(lit_walls)

    def metres(self) -> Float32Array:
        """The newest depth picture, m, (height, width), which the next one overwrites."""
        self._depth_target.read_into(self._depth_m, components=1, dtype="f4")
        return self._depth_m

    def close(self) -> None:
        for thing in self._owned:
            thing.release()
        self._owned.clear()

    # --- passes -----------------------------------------------------------------------------------

    def _draw_projector_map(self, pose: FloatArray, baseline_m: float) -> None:
        """Draw the depth seen from the projector. It stands beside the depth camera and looks the same way, so a row of
        its map is a row of the depth picture."""
        wide = projector_camera(self.camera, baseline_m)
        if self._projector_map is None:
            self._projector_map = self._shadow_map((wide.width, wide.height), moderngl.NEAREST)
        view = projection(wide, near_m=PROJECTOR_NEAR_M) @ rigid_inverse(pose)
        self._draw_shadow_map(self._projector_map, view)
        nearer = view.copy()
        nearer[2] -= 2 * PROJECTOR_NEAR_M * PROJECTOR_BIAS_PER_M * view[3]
        _set(self._metres, projector=nearer)
        self._projector_map.depth.use(0)

    def _draw_shadow_map(self, shadow_map: _ShadowMap, view: FloatArray, front_face: str = "cw") -> None:
        target = shadow_map.target
        _set(self._shade, view=view)
        target.use()
        target.scissor = (0, 0, target.width, target.height)
        target.clear()
        # The outermost texels stay empty: lookups outside of the map are clamped to them, and find light.
        target.scissor = (1, 1, target.width - 2, target.height - 2)
        self._ctx.front_face = front_face
        for mesh in self._objects:
            mesh.draw(self._shade)
        self._ctx.front_face = "cw"

    # --- making -----------------------------------------------------------------------------------

    def _program(self, vertex: str, fragment: str) -> moderngl.Program:
        source = resources.files("sim.render").joinpath("shaders")
        program = self._ctx.program(
            vertex_shader=source.joinpath(f"{vertex}.vert.glsl").read_text(),
            fragment_shader=source.joinpath(f"{fragment}.frag.glsl").read_text(),
        )
        self._owned.append(program)
        return program

    def _target(self, pixels: moderngl.Renderbuffer, depth: moderngl.Renderbuffer) -> moderngl.Framebuffer:
        target = self._ctx.framebuffer([pixels], depth)
        self._owned += [target, pixels, depth]
        return target

    def _shadow_map(self, size: tuple[int, int], texture_filter: int) -> _ShadowMap:
        depth = self._ctx.depth_texture(size)
        depth.compare_func = "<="
        depth.repeat_x = depth.repeat_y = False
        depth.filter = (texture_filter, texture_filter)
        target = self._ctx.framebuffer([], depth)
        self._owned += [target, depth]
        return _ShadowMap(depth, target)


@cache
def context() -> moderngl.Context:
    """The process's only OpenGL context, which all its renderers share."""
    create: Any = moderngl.create_context
    ctx: moderngl.Context = create(standalone=True, require=330, backend="egl", **LIBRARIES)
    ctx.front_face = "cw"  # rows run downwards (see `projection`), which mirrors the winding
    return ctx


def _set(program: moderngl.Program, **values: ArrayLike) -> None:
    """Set uniforms. Matrices are written row by row: the shaders multiply vector * matrix."""
    for name, value in values.items():
        uniform: Any = program[name]
        uniform.write(np.asarray(value, np.float32).tobytes())


def _reaches_walls(direction: FloatArray, about_m: FloatArray) -> bool:
    """Whether the cube that has shadows may contain a part of the walls, or of the ceiling if light comes from below.

    `direction`: of the lamp's light, (3,); `about_m`: the middle of the cube, (3,).
    """
    corner_m = 3**0.5 * LAMP_HALF_WIDTH_M
    return bool(direction[2] > 0 or np.abs(about_m[:2]).max() + corner_m > HALF_WIDTH_M - WALL_PARTS_M)


def _floor_ahead(pose: FloatArray) -> FloatArray:
    """The point on the floor in front of the camera about which shadows are drawn, (3,), m."""
    ahead = pose[:2, 2] / max(float(np.linalg.norm(pose[:2, 2])), 1e-6)
    return np.array([*(pose[:2, 3] + LAMP_AHEAD_M * ahead), 0.0])
