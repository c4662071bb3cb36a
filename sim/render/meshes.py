"""Triangles of the three primitives at unit size: a row is a corner's position (3) and its normal (3).

Scaled by `scale_of`, a mesh has the visual's size. Triangles wind counter-clockwise seen from outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import pi

import moderngl
import numpy as np
from numpy.typing import ArrayLike

from cocoro.arrays import Float32Array, FloatArray
from sim.render.interface import Shape, Visual
from sim.render.room import HALF_WIDTH_M, walls

TriangleMesh = Float32Array

CYLINDER_SLICES = 32
"""At a can's 33 mm radius the flat sides are at most 0.16 mm inside of the round."""
SPHERE_SLICES, SPHERE_STACKS = 24, 12
"""At a ball's 30 mm radius at most 0.5 mm inside; small triangles are what costs most in a small picture."""


def scale_of(visual: Visual) -> tuple[float, float, float]:
    """What the unit mesh is multiplied by along x, y, z."""
    match visual.shape, visual.size_m:
        case "box", (x, y, z):
            return x, y, z
        case "cylinder", (radius, height):
            return radius, radius, height
        case "sphere", (radius,):
            return radius, radius, radius
    raise ValueError(f"visual {visual.name!r}: a {visual.shape} cannot have the size {visual.size_m}")


def mesh(shape: Shape) -> TriangleMesh:
    """Triangle corners of a unit primitive, shape (3 * triangles, 6), float32."""
    build = {"box": box, "cylinder": cylinder, "sphere": sphere}[shape]
    return build()


def box() -> TriangleMesh:
    """A cube of side 1."""
    faces = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            # u x v points along +axis; the quad is turned round on the negative side.
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            centre = np.eye(3)[axis] * sign
            quad = [centre + (a * u + b * v) / 2 for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            if sign < 0:
                quad.reverse()
            faces.append(_quad(quad, [2 * centre] * 4))
    return _stack(faces)


def square() -> TriangleMesh:
    """Side 1, in the plane z = 0, seen from above."""
    up = np.array([0.0, 0.0, 1.0])
    corners = [np.array([x, y, 0.0]) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    return _stack([_quad(corners, [up] * 4)])


def cylinder() -> TriangleMesh:
    """Radius 1, height 1, the axis along z."""
    rim = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(CYLINDER_SLICES + 1) * 2 * pi / CYLINDER_SLICES]
    up = np.array([0.0, 0.0, 1.0])
    parts = []
    for a, b in pairwise(rim):
        parts.append(_quad([a - up / 2, b - up / 2, b + up / 2, a + up / 2], [a, b, b, a]))
        parts.append(_triangle([up / 2, a + up / 2, b + up / 2], [up] * 3))
        parts.append(_triangle([-up / 2, b - up / 2, a - up / 2], [-up] * 3))
    return _stack(parts)


def sphere() -> TriangleMesh:
    """Radius 1."""

    def corner(stack: int, slice_: int) -> FloatArray:
        down, round_ = stack * pi / SPHERE_STACKS, slice_ * 2 * pi / SPHERE_SLICES
        return np.array([np.sin(down) * np.cos(round_), np.sin(down) * np.sin(round_), np.cos(down)])

    parts = []
    for stack in range(SPHERE_STACKS):
        for slice_ in range(SPHERE_SLICES):
            quad = [
                corner(stack, slice_),
                corner(stack + 1, slice_),
                corner(stack + 1, slice_ + 1),
                corner(stack, slice_ + 1),
            ]
            parts.append(_quad(quad, quad))
    return _stack(parts)


def _triangle(corners: list[FloatArray], normals: list[FloatArray]) -> FloatArray:
    return np.hstack([np.array(corners), np.array(normals)])


def _quad(corners: list[FloatArray], normals: list[FloatArray]) -> FloatArray:
    rows = _triangle(corners, normals)
    return rows[[0, 1, 2, 0, 2, 3]]


def _stack(parts: list[FloatArray]) -> TriangleMesh:
    return np.vstack(parts).astype(np.float32)


class InstancedMesh:
    """One mesh and its instances: what is fixed of each (scale and colour), and where each stands in this frame.

    Args:
        corners: the mesh, see `meshes`.
        rows: which of the frame's poses are these instances'.
        scales, rgbs: (n, 3) each.
    """

    def __init__(
        self, ctx: moderngl.Context, corners: TriangleMesh, rows: Sequence[int], scales: ArrayLike, rgbs: ArrayLike
    ) -> None:
        self._ctx = ctx
        self._rows = list(rows)
        # A corner that several triangles share is transformed once.
        corners, order = np.unique(corners, axis=0, return_inverse=True)
        self._corners = ctx.buffer(corners.tobytes())
        self._order = ctx.buffer(order.astype(np.uint32).tobytes())
        self._fixed = ctx.buffer(np.hstack([scales, rgbs]).astype(np.float32).tobytes())
        self._poses = ctx.buffer(reserve=64 * len(self._rows))
        self._arrays: dict[moderngl.Program, moderngl.VertexArray] = {}

    def place(self, poses: Float32Array) -> None:
        """Where everything stands in this frame: (m, 4, 4), of which this batch takes its rows."""
        self._poses.write(poses[self._rows].tobytes())

    def draw(self, program: moderngl.Program) -> None:
        """Draw all instances into the framebuffer in use."""
        if program not in self._arrays:
            parts = [
                _layout(program, self._corners, "", ("3f", "in_corner"), ("3f", "in_normal")),
                _layout(program, self._fixed, "/i", ("3f", "in_scale"), ("3f", "in_rgb")),
                _layout(program, self._poses, "/i", ("16f", "in_pose")),
            ]
            self._arrays[program] = self._ctx.vertex_array(program, parts, self._order)
        self._arrays[program].render(moderngl.TRIANGLES, instances=len(self._rows))

    def release(self) -> None:
        for array in self._arrays.values():
            array.release()
        for buffer in (self._corners, self._order, self._fixed, self._poses):
            buffer.release()


def _layout(
    program: moderngl.Program, buffer: moderngl.Buffer, divisor: str, *fields: tuple[str, str]
) -> tuple[moderngl.Buffer | str, ...]:
    """One buffer's fields as moderngl wants them told; what the program does not read is padding."""
    read = [(size, name) for size, name in fields if name in program]
    sizes = [size if name in program else f"{4 * int(size[:-1])}x" for size, name in fields]
    return (buffer, " ".join(sizes) + divisor, *(name for _, name in read))


def batches_of(ctx: moderngl.Context, visuals: Sequence[Visual]) -> list[InstancedMesh]:
    """One batch a shape."""
    shapes: list[Shape] = sorted({visual.shape for visual in visuals})
    batches = []
    for shape in shapes:
        rows = [row for row, visual in enumerate(visuals) if visual.shape == shape]
        chosen = [visuals[row] for row in rows]
        scales, rgbs = [scale_of(visual) for visual in chosen], [visual.rgb for visual in chosen]
        batches.append(InstancedMesh(ctx, mesh(shape), rows, scales, rgbs))
    return batches


def floor_batch(ctx: moderngl.Context) -> InstancedMesh:
    """The floor of the room."""
    floor = InstancedMesh(ctx, square(), [0], [[2 * HALF_WIDTH_M] * 3], [[0.0] * 3])
    floor.place(np.eye(4, dtype=np.float32)[None])
    return floor


def wall_batch(ctx: moderngl.Context) -> InstancedMesh:
    """Walls, skirting and ceiling of the room."""
    parts = walls()
    (batch,) = batches_of(ctx, [visual for visual, _ in parts])
    poses = np.tile(np.eye(4, dtype=np.float32), (len(parts), 1, 1))
    poses[:, :3, 3] = [centre for _, centre in parts]
    batch.place(poses)
    return batch
