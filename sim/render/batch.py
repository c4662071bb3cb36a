"""What the OpenGL renderer draws with one call: every visual of one shape, by instancing."""

from __future__ import annotations

from collections.abc import Sequence

import moderngl
import numpy as np
from numpy.typing import ArrayLike

from cocoro.arrays import Float32Array
from sim.render.meshes import Mesh, mesh, scale_of, square
from sim.render.room import HALF_WIDTH_M, walls
from sim.visual import Shape, Visual


class Batch:
    """One mesh and its instances: what is fixed of each (scale and colour), and where each stands in this frame.

    Args:
        corners: the mesh, see `meshes`.
        rows: which of the frame's poses are these instances'.
        scales, rgbs: (n, 3) each.
    """

    def __init__(
        self, ctx: moderngl.Context, corners: Mesh, rows: Sequence[int], scales: ArrayLike, rgbs: ArrayLike
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


def batches_of(ctx: moderngl.Context, visuals: Sequence[Visual]) -> list[Batch]:
    """One batch a shape."""
    shapes: list[Shape] = sorted({visual.shape for visual in visuals})
    batches = []
    for shape in shapes:
        rows = [row for row, visual in enumerate(visuals) if visual.shape == shape]
        chosen = [visuals[row] for row in rows]
        scales, rgbs = [scale_of(visual) for visual in chosen], [visual.rgb for visual in chosen]
        batches.append(Batch(ctx, mesh(shape), rows, scales, rgbs))
    return batches


def floor_batch(ctx: moderngl.Context) -> Batch:
    """The floor of the room."""
    floor = Batch(ctx, square(), [0], [[2 * HALF_WIDTH_M] * 3], [[0.0] * 3])
    floor.place(np.eye(4, dtype=np.float32)[None])
    return floor


def wall_batch(ctx: moderngl.Context) -> Batch:
    """Walls, skirting and ceiling of the room."""
    parts = walls()
    (batch,) = batches_of(ctx, [visual for visual, _ in parts])
    poses = np.tile(np.eye(4, dtype=np.float32), (len(parts), 1, 1))
    poses[:, :3, 3] = [centre for _, centre in parts]
    batch.place(poses)
    return batch
