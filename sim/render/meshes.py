"""Triangles of the three primitives at unit size: a row is a corner's position (3) and its normal (3).

Scaled by `scale_of`, a mesh has the visual's size. Triangles wind counter-clockwise seen from outside.
"""

from __future__ import annotations

from itertools import pairwise
from math import pi

import numpy as np

from cocoro.arrays import Float32Array, FloatArray
from sim.visual import Shape, Visual

Mesh = Float32Array

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


def mesh(shape: Shape) -> Mesh:
    """Triangle corners of a unit primitive, shape (3 * triangles, 6), float32."""
    build = {"box": box, "cylinder": cylinder, "sphere": sphere}[shape]
    return build()


def box() -> Mesh:
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


def square() -> Mesh:
    """Side 1, in the plane z = 0, seen from above."""
    up = np.array([0.0, 0.0, 1.0])
    corners = [np.array([x, y, 0.0]) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    return _stack([_quad(corners, [up] * 4)])


def cylinder() -> Mesh:
    """Radius 1, height 1, the axis along z."""
    rim = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(CYLINDER_SLICES + 1) * 2 * pi / CYLINDER_SLICES]
    up = np.array([0.0, 0.0, 1.0])
    parts = []
    for a, b in pairwise(rim):
        parts.append(_quad([a - up / 2, b - up / 2, b + up / 2, a + up / 2], [a, b, b, a]))
        parts.append(_triangle([up / 2, a + up / 2, b + up / 2], [up] * 3))
        parts.append(_triangle([-up / 2, b - up / 2, a - up / 2], [-up] * 3))
    return _stack(parts)


def sphere() -> Mesh:
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


def _stack(parts: list[FloatArray]) -> Mesh:
    return np.vstack(parts).astype(np.float32)
