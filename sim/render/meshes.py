"""Triangle meshes of the three primitives at unit size, and their drawing by OpenGL in instances.

A row of a mesh is the position (3) and the normal (3) of a triangle's corner. `scale_of` scales a mesh to the size of a
visual. Triangles wind counter-clockwise seen from outside.
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
"""At a can's radius of 33 mm the flat faces are at most 0.16 mm inside the cylinder."""
SPHERE_SLICES, SPHERE_STACKS = 24, 12
"""At a ball's radius of 30 mm the faces are at most 0.5 mm inside the sphere. More triangles would cost much time in
small pictures."""


def scale_of(visual: Visual) -> tuple[float, float, float]:
    """Factors along x, y, z that scale the unit mesh to the visual's size. Raises ValueError for a size that does not
    fit the shape."""
    match visual.shape, visual.size_m:
        case "box", (x, y, z):
            return x, y, z
        case "cylinder", (radius, height):
            return radius, radius, height
        case "sphere", (radius,):
            return radius, radius, radius
    raise ValueError(f"visual {visual.name!r}: a {visual.shape} cannot have the size {visual.size_m}")


def mesh(shape: Shape) -> TriangleMesh:
    """Triangle corners of a unit primitive, (3 * triangles, 6)."""
    build = {"box": box, "cylinder": cylinder, "sphere": sphere}[shape]
    return build()


def box() -> TriangleMesh:
    """A cube of side 1."""
    faces = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            # u x v points along +axis, so the quad is reversed on the negative side.
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            centre = np.eye(3)[axis] * sign
            quad = [centre + (a * u + b * v) / 2 for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            if sign < 0:
                quad.reverse()
            faces.append(_quad(quad, [2 * centre] * 4))
    return _stack(faces)


def square() -> TriangleMesh:
    """A square of side 1 in the plane z = 0, facing up."""
    up = np.array([0.0, 0.0, 1.0])
    corners = [np.array([x, y, 0.0]) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    return _stack([_quad(corners, [up] * 4)])


def cylinder() -> TriangleMesh:
    """A cylinder of radius 1 and height 1 about z."""
    rim = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(CYLINDER_SLICES + 1) * 2 * pi / CYLINDER_SLICES]
    up = np.array([0.0, 0.0, 1.0])
    parts = []
    for a, b in pairwise(rim):
        parts.append(_quad([a - up / 2, b - up / 2, b + up / 2, a + up / 2], [a, b, b, a]))
        parts.append(_triangle([up / 2, a + up / 2, b + up / 2], [up] * 3))
        parts.append(_triangle([-up / 2, b - up / 2, a - up / 2], [-up] * 3))
    return _stack(parts)


def sphere() -> TriangleMesh:
    """A sphere of radius 1."""

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
    """A mesh and its instances, drawn with one call: scale and colour are fixed, the poses change with each frame.

    Args:
        corners: the mesh, (3 * triangles, 6).
        rows: the indices of these instances among the frame's poses.
        scales, rgbs: scale and colour of each instance, (n, 3).
    """

    def __init__(
        self, ctx: moderngl.Context, corners: TriangleMesh, rows: Sequence[int], scales: ArrayLike, rgbs: ArrayLike
    ) -> None:
        self._ctx = ctx
        self._rows = list(rows)
        # Corners that several triangles share are transformed once.
        corners, order = np.unique(corners, axis=0, return_inverse=True)
        self._corners = ctx.buffer(corners.tobytes())
        self._order = ctx.buffer(order.astype(np.uint32).tobytes())
        self._fixed = ctx.buffer(np.hstack([scales, rgbs]).astype(np.float32).tobytes())
        self._poses = ctx.buffer(reserve=64 * len(self._rows))
        self._arrays: dict[moderngl.Program, moderngl.VertexArray] = {}

    def place(self, poses: Float32Array) -> None:
        """Set the instances' poses from the poses of the frame, (m, 4, 4)."""
        self._poses.write(poses[self._rows].tobytes())

    def draw(self, program: moderngl.Program) -> None:
        """Draw all instances into the current framebuffer."""
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
    """A buffer's fields in moderngl's format. Fields that the program does not read become padding."""
    read = [(size, name) for size, name in fields if name in program]
    sizes = [size if name in program else f"{4 * int(size[:-1])}x" for size, name in fields]
    return (buffer, " ".join(sizes) + divisor, *(name for _, name in read))


def instanced_meshes(ctx: moderngl.Context, visuals: Sequence[Visual]) -> list[InstancedMesh]:
    """One instanced mesh for each shape among the visuals."""
    shapes: list[Shape] = sorted({visual.shape for visual in visuals})
    meshes = []
    for shape in shapes:
        rows = [row for row, visual in enumerate(visuals) if visual.shape == shape]
        chosen = [visuals[row] for row in rows]
        scales, rgbs = [scale_of(visual) for visual in chosen], [visual.rgb for visual in chosen]
        meshes.append(InstancedMesh(ctx, mesh(shape), rows, scales, rgbs))
    return meshes


def floor_mesh(ctx: moderngl.Context) -> InstancedMesh:
    """The room's floor."""
    floor = InstancedMesh(ctx, square(), [0], [[2 * HALF_WIDTH_M] * 3], [[0.0] * 3])
    floor.place(np.eye(4, dtype=np.float32)[None])
    return floor


def wall_mesh(ctx: moderngl.Context) -> InstancedMesh:
    """The room's walls, skirting boards and ceiling."""
    parts = walls()
    (mesh,) = instanced_meshes(ctx, [visual for visual, _ in parts])
    poses = np.tile(np.eye(4, dtype=np.float32), (len(parts), 1, 1))
    poses[:, :3, 3] = [centre for _, centre in parts]
    mesh.place(poses)
    return mesh
