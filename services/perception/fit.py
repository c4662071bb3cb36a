"""Fits upright known shapes to the evidence of where they are, all objects of a frame at once.

Gauss-Newton on signed distances with Huber weights. Residuals: a surface point's distance from the shape, over its
depth's standard deviation; the distance by which a ray of the outline misses the shape; the depth by which a free ray
beside it enters the shape. The latter two are one-sided. Derived.
"""

from __future__ import annotations

import numpy as np

from cocoro.arrays import FloatArray
from services.perception.image import Evidence
from services.perception.rays import Rays
from services.perception.shapes import Shapes, Solids

ITERATIONS = 12
SETTLED_M = 2e-3
"""A fit ends when a step moves it by less: most fits then are within a tenth of it."""
PRIOR = np.eye(3) / 0.05**2
"""Inverse covariance of the first guess, 1/m2: it may be 5 cm off and decides only what the evidence leaves open."""
RAY_DOUBT_M, RAY_DOUBT_RAD = 0.001, 0.002
"""Standard deviation of the outline: a constant, and about a pixel at the object's distance."""
INSET_RAD = 0.002
"""How far inside the true outline the outermost pixels found are on average: a pixel at 640 x 480."""
HUBER = 1.5


def fit_centres(
    shapes: Shapes, evidence: Evidence, pose: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The centre of each object's upright shape that fits its evidence best, body frame, m, shape (n, 3), and its mean
    misfit, shape (n,).

    `pose` is the camera's pose in the body frame, 4 x 4; `start` the first guesses, m, shape (n, 3).
    """
    moved, misfit = _Fits(shapes, evidence, pose[:3, :3], start - pose[:3, 3]).settle()
    wandered = (moved * moved).sum(axis=1) >= 4 * shapes.reach_m**2
    moved[wandered] = 0.0
    return start + moved, misfit


class _Fits:
    """Fits under way, n of them, in step. Lengths are m, relative to the first guess, in the body's axes.

    Each row of the arrays (n, k) is one fit's evidence: points on the surface, then rays of the outline, then free
    rays, then fill, which counts nothing.
    """

    def __init__(self, shapes: Shapes, evidence: Evidence, rotation: FloatArray, guess: FloatArray) -> None:
        """`rotation` (3, 3) turns the camera's axes into the body's; `guess` (n, 3) is relative to the camera."""
        self._solids = Solids(shapes)
        self._side = evidence.side
        self._count = evidence.count
        self.moved = np.zeros_like(guess)
        self._eye = -guess.T[:, :, None].astype(np.float32)
        turn = rotation.astype(np.float32)
        rays = (turn @ evidence.rays.reshape(3, -1)).reshape(evidence.rays.shape)
        self._rays = Rays(self._solids, rays, evidence.free_to_m)
        self._points = (turn @ evidence.points_m.reshape(3, -1)).reshape(evidence.points_m.shape)
        self._points += self._eye
        depth = guess @ rotation[:, 2]
        self._inset = np.maximum(evidence.side, 0) * (INSET_RAD * depth).astype(np.float32)[:, None]
        ray_certainty = 1 / (RAY_DOUBT_M + RAY_DOUBT_RAD * depth)
        of_rays = np.abs(evidence.side) * ray_certainty.astype(np.float32)[:, None]
        self._certainty = np.concatenate([evidence.certainty, of_rays], axis=1)
        self._certainty2 = self._certainty * self._certainty * np.float32(HUBER)

    def settle(self) -> tuple[FloatArray, FloatArray]:
        """Step until each fit settles, and then leave it. Returns how far each moved in all, m, (n, 3), and its mean
        misfit, (n,)."""
        going = np.ones(len(self.moved), dtype=np.bool_)
        for _ in range(ITERATIONS):
            move = self._move()
            move[~going] = 0.0
            self.moved += move
            going &= np.abs(move).max(axis=1) >= SETTLED_M
            if not going.any():
                break
        return self.moved, self._misfit()

    def _misfit(self) -> FloatArray:
        """Mean misfit before the last step, (n,)."""
        size = self._size
        loss = np.where(size < HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER))
        misfit: FloatArray = loss.sum(axis=1) / self._count
        return misfit

    def _move(self) -> FloatArray:
        """The step that each fit should make, m, (n, 3)."""
        moved = self.moved.T[:, :, None].astype(np.float32)
        offsets = np.concatenate([self._points - moved, self._rays.nearest(self._eye - moved)], axis=2)
        distance, along = self._solids.gradient(offsets)
        # A ray of the outline that is well inside the shape is no evidence, nor is a free one outside of it.
        missed = distance[:, -self._side.shape[1] :]
        missed *= self._side
        missed += self._inset
        np.maximum(missed, 0, out=missed)
        missed *= self._side
        self._size = np.abs(distance) * self._certainty
        weight = self._certainty2 / np.maximum(self._size, np.float32(HUBER))
        weight *= distance != 0
        weighted = (along * weight).transpose(1, 0, 2)
        curvature = weighted @ along.transpose(1, 2, 0) + PRIOR
        pull = weighted @ distance[:, :, None] - PRIOR @ self.moved[:, :, None]
        move: FloatArray = np.linalg.solve(curvature, pull)[..., 0]
        return move
