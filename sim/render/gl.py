"""The fast renderer: OpenGL 3.3 through moderngl on EGL, without a display; on a machine without a graphics
card Mesa draws on the processor (llvmpipe).

A frame is up to four passes: the lamp's shadow map, the colour camera's picture, the projector's shadow map,
and the depth camera's metres. Each draws every primitive by instancing: one call a shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any

import cv2
import moderngl
import numpy as np

from cocoro.kinematics import Array
from cocoro.robot import Camera
from sim.render.interface import Images, Light
from sim.render.meshes import box, mesh, scale_of
from sim.render.room import COLOURS, HALF_WIDTH_M, HEIGHT_M, SKIRTING_M, TILE_M
from sim.render.views import (
    PROJECTOR_BIAS_PER_M,
    PROJECTOR_NEAR_M,
    lamp_tint,
    lamp_view,
    projection,
    projector_camera,
    rigid_inverse,
)
from sim.visual import Visual

LAMP_TEXELS = 512
LAMP_HALF_WIDTH_M = 2.0
"""Shadows are drawn in a cube of this half width, 8 mm a texel, before the camera; beyond it all is lit."""
LAMP_AHEAD_M = 1.2


@cache
def _context() -> Any:
    """The process's one OpenGL context: renderers share it, and switching between contexts would cost more
    than a pass. The names with a version are what a machine without development packages has."""
    create: Any = moderngl.create_context
    return create(standalone=True, require=330, backend="egl", libgl="libGL.so.1", libegl="libEGL.so.1")


def _program(ctx: Any, vertex: str, fragment: str) -> Any:
    source = resources.files("sim.render").joinpath("shaders")
    return ctx.program(
        vertex_shader=source.joinpath(f"{vertex}.vert.glsl").read_text(),
        fragment_shader=source.joinpath(f"{fragment}.frag.glsl").read_text(),
    )


def _set(program: Any, **values: Any) -> None:
    """Set uniforms; those that a program does not use are skipped."""
    for name, value in values.items():
        if name in program:
            program[name].write(np.asarray(value, np.float32).tobytes())


class _Batch:
    """All visuals of one shape: the mesh, what is fixed of each instance, and the poses of the frame."""

    def __init__(self, ctx: Any, corners: Any, rows: list[int], scales: Any, rgbs: Any) -> None:
        self.rows = rows
        self._count = len(rows)
        self._corners = ctx.buffer(corners.tobytes())
        fixed = np.hstack([scales, rgbs]).astype(np.float32)
        self._fixed = ctx.buffer(fixed.tobytes())
        self._poses = ctx.buffer(reserve=64 * self._count)
        self._ctx = ctx
        self._arrays: dict[Any, Any] = {}

    def place(self, poses: Any) -> None:
        """`poses` is (n, 4, 4) float32 of all visuals."""
        self._poses.write(np.ascontiguousarray(poses[self.rows]))

    def draw(self, program: Any) -> None:
        if program not in self._arrays:
            self._arrays[program] = self._ctx.vertex_array(
                program,
                [
                    self._part(program, self._corners, ("3f", "in_corner"), ("3f", "in_normal")),
                    self._part(program, self._fixed, ("3f", "in_scale"), ("3f", "in_rgb"), each="instance"),
                    self._part(program, self._poses, ("16f", "in_pose"), each="instance"),
                ],
            )
        self._arrays[program].render(moderngl.TRIANGLES, instances=self._count)

    @staticmethod
    def _part(program: Any, buffer: Any, *fields: tuple[str, str], each: str = "vertex") -> tuple[Any, ...]:
        """One buffer's layout for a program that may not use every field of it."""
        used = [(size, name) if name in program else (f"{4 * int(size[:-1])}x", None) for size, name in fields]
        layout = " ".join(size for size, _ in used) + ("/i" if each == "instance" else "")
        return (buffer, layout, *(name for _, name in used if name is not None))

    def release(self) -> None:
        for thing in (*self._arrays.values(), self._corners, self._fixed, self._poses):
            thing.release()


class GlRenderer:
    """See `interface.Renderer`. Raises whatever moderngl raises when there is no OpenGL."""

    name = "moderngl"

    def __init__(self, visuals: Sequence[Visual], camera: Camera) -> None:
        self.camera = camera
        self._ctx = ctx = _context()
        self._batches = [
            _Batch(
                ctx,
                mesh(shape),
                rows,
                np.array([scale_of(visuals[i]) for i in rows]),
                np.array([visuals[i].rgb for i in rows]),
            )
            for shape in ("box", "cylinder", "sphere")
            if (rows := [i for i, visual in enumerate(visuals) if visual.shape == shape])
        ]
        self._room = self._make_room()
        self._object = _program(ctx, "object", "object")
        self._walls = _program(ctx, "room", "room")
        self._metres = _program(ctx, "depth", "depth")
        self._shade = _program(ctx, "shadow", "shadow")
        _set(
            self._walls,
            floor_rgb=COLOURS.floor,
            floor_other_rgb=COLOURS.floor_other,
            wall_rgb=COLOURS.wall,
            skirting_rgb=COLOURS.skirting,
            ceiling_rgb=COLOURS.ceiling,
            tile_m=TILE_M,
            skirting_m=SKIRTING_M,
        )
        size = (camera.width, camera.height)
        self._colour_target = ctx.framebuffer([ctx.renderbuffer(size, 4)], ctx.depth_renderbuffer(size))
        self._depth_target = ctx.framebuffer([ctx.renderbuffer(size, 1, dtype="f4")], ctx.depth_renderbuffer(size))
        self._lamp_map = self._make_shadow_map((LAMP_TEXELS, LAMP_TEXELS), smooth=True)
        self._projector_map: Any = None
        self._rgba = np.empty((camera.height, camera.width, 4), np.uint8)
        self._rgb = np.empty((camera.height, camera.width, 3), np.uint8)
        self._depth = np.empty((camera.height, camera.width), np.float32)
        self._projection = projection(camera)

    def _make_room(self) -> _Batch:
        corners = box().reshape(-1, 3, 6)[:, ::-1].reshape(-1, 6)  # seen from inside
        corners[:, 3:] *= -1
        scale = [[2 * HALF_WIDTH_M, 2 * HALF_WIDTH_M, HEIGHT_M]]
        room = _Batch(self._ctx, corners, [0], np.array(scale), np.zeros((1, 3)))
        pose = np.eye(4, dtype=np.float32)[None]
        pose[0, 2, 3] = HEIGHT_M / 2
        room.place(pose)
        return room

    def _make_shadow_map(self, size: tuple[int, int], *, smooth: bool) -> Any:
        texture = self._ctx.depth_texture(size)
        texture.compare_func = "<="
        texture.repeat_x = texture.repeat_y = False
        texture.filter = (moderngl.LINEAR, moderngl.LINEAR) if smooth else (moderngl.NEAREST, moderngl.NEAREST)
        return self._ctx.framebuffer([], texture)

    def render(
        self,
        poses: Array,
        camera_pose: Array,
        depth_camera_pose: Array,
        light: Light,
        projector_pose: Array | None = None,
    ) -> Images:
        ctx = self._ctx
        ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        ctx.front_face = "cw"  # rows run downwards (see `projection`), which mirrors the winding
        placed = poses.astype(np.float32)
        for batch in self._batches:
            batch.place(placed)
        self._draw_colour(camera_pose, light)
        self._draw_depth(depth_camera_pose, projector_pose)
        self._colour_target.read_into(self._rgba, components=4)
        cv2.cvtColor(self._rgba, cv2.COLOR_RGBA2RGB, dst=self._rgb)
        self._depth_target.read_into(self._depth, components=1, dtype="f4")
        return Images(self._rgb, self._depth)

    def _draw_colour(self, pose: Array, light: Light) -> None:
        direction = np.asarray(light.direction, float)
        direction = direction / np.linalg.norm(direction)
        lamp = lamp_view(direction, _floor_ahead(pose), LAMP_HALF_WIDTH_M, LAMP_TEXELS)
        self._draw_shadow_map(self._lamp_map, lamp, front_face="ccw")

        tint = lamp_tint(light.temperature_k)
        self._lamp_map.depth_attachment.use(0)
        for program in (self._object, self._walls):
            _set(
                program,
                view=self._projection @ rigid_inverse(pose),
                lamp=lamp,
                to_lamp=-direction,
                eye=pose[:3, 3],
                ambient=light.ambient * tint,
                diffuse=light.diffuse * tint,
            )
        self._colour_target.use()
        self._colour_target.clear()
        for batch in self._batches:
            batch.draw(self._object)
        self._room.draw(self._walls)

    def _draw_depth(self, pose: Array, projector_pose: Array | None) -> None:
        view = rigid_inverse(pose)
        _set(self._metres, view=self._projection @ view, axis=view[2])
        self._metres["projecting"].value = projector_pose is not None
        if projector_pose is not None:
            self._draw_projector_map(projector_pose, float(np.linalg.norm(projector_pose[:3, 3] - pose[:3, 3])))
        self._depth_target.use()
        self._depth_target.clear(red=np.inf)
        for batch in self._batches:
            batch.draw(self._metres)
        self._room.draw(self._metres)

    def _draw_projector_map(self, pose: Array, baseline_m: float) -> None:
        """What the projector's light reaches. It stands beside the depth camera and looks the same way, so a row
        of its map is a row of the depth picture."""
        wide = projector_camera(self.camera, baseline_m)
        if self._projector_map is None:
            self._projector_map = self._make_shadow_map((wide.width, wide.height), smooth=False)
        view = projection(wide, near_m=PROJECTOR_NEAR_M) @ rigid_inverse(pose)
        self._draw_shadow_map(self._projector_map, view, front_face="cw")
        nearer = view.copy()
        nearer[2] -= 2 * PROJECTOR_NEAR_M * PROJECTOR_BIAS_PER_M * view[3]
        _set(self._metres, projector=nearer)
        self._projector_map.depth_attachment.use(0)

    def _draw_shadow_map(self, target: Any, view: Array, *, front_face: str) -> None:
        ctx = self._ctx
        _set(self._shade, view=view)
        ctx.front_face = front_face
        target.use()
        target.scissor = None
        target.clear()
        # The outermost texels stay empty: outside of the map all is lit.
        target.scissor = (1, 1, target.width - 2, target.height - 2)
        for batch in self._batches:
            batch.draw(self._shade)
        ctx.front_face = "cw"

    def close(self) -> None:
        for batch in (*self._batches, self._room):
            batch.release()


def _floor_ahead(pose: Array) -> Array:
    """Where the shadows matter: on the floor a little before the camera, (3,)."""
    ahead = pose[:2, 2] / max(float(np.linalg.norm(pose[:2, 2])), 1e-6)
    return np.array([*(pose[:2, 3] + LAMP_AHEAD_M * ahead), 0.0])
