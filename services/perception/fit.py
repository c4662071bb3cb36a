"""Fits upright known shapes to the evidence of where they are, all objects of a frame at once.

Gauss-Newton on signed distances with Huber weights. Residuals: a surface point's distance from the shape, over its
depth's standard deviation; the distance by which a ray of the outline misses the shape; the depth by which a free ray
beside it enters the shape. The latter two are one-sided. Derived.
"""

from __future__ import annotations

import numpy as np

from cocoro.arrays import BoolArray, Float32Array, FloatArray
from services.perception.image import Evidence
from services.perception.shapes import Shapes, Solids

ITERATIONS = 12
SETTLED_M = 3e-4
PRIOR = np.eye(3) / 0.05**2
"""Inverse covariance of the first guess, 1/m2: it may be 5 cm off and decides only what the evidence leaves open."""
RAY_SAMPLES = 5
RAY_DOUBT_M, RAY_DOUBT_RAD = 0.001, 0.002
"""Standard deviation of the outline: a constant, and about a pixel at the object's distance."""
MANY = 16
COARSE, COARSE_ITERATIONS, COARSE_SETTLED_M = 3, 4, 1e-3
"""So many fits go most of the way by every third piece of evidence, in so many steps at most, until the centre settles to
a millimetre: that takes a third of the time. Of fewer fits the calls take the time, not the numbers."""
HUBER = 1.5


def fit_centres(
    shapes: Shapes, evidence: Evidence, pose: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The centre of each object's upright shape that fits its evidence best, body frame, m, shape (n, 3), and its mean
    misfit, shape (n,).

    `pose` is the camera's pose in the body frame, 4 x 4; `start` the first guesses, m, shape (n, 3).
    """
    rotation, guess = pose[:3, :3], start - pose[:3, 3]
    fits = _Fits(shapes, evidence, rotation, guess)
    if len(start) >= MANY:
        nearby = _Fits(shapes, evidence.every(COARSE), rotation, guess)
        fits.moved = nearby.settle(COARSE_ITERATIONS, COARSE_SETTLED_M)[0]
    moved, misfit = fits.settle(ITERATIONS, SETTLED_M)
    wandered = np.linalg.norm(moved, axis=1) >= 2 * shapes.reach_m
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
        self._free_to = evidence.free_to_m
        self._count = evidence.count
        self.moved = np.zeros_like(guess)
        self._eye = -guess.T[:, :, None].astype(np.float32)
        turn = rotation.astype(np.float32)
        self._rays = (turn @ evidence.rays.reshape(3, -1)).reshape(evidence.rays.shape)
        points = (turn @ evidence.points_m.reshape(3, -1)).reshape(evidence.points_m.shape)
        points += self._eye
        self._at = np.concatenate([points, self._rays], axis=2)
        ray_certainty = 1 / (RAY_DOUBT_M + RAY_DOUBT_RAD * (guess @ rotation[:, 2]))
        of_rays = np.abs(evidence.side) * ray_certainty.astype(np.float32)[:, None]
        self._certainty = np.concatenate([evidence.certainty, of_rays], axis=1)
        self._certainty2 = self._certainty * self._certainty * np.float32(HUBER)
        x, y, z = self._rays
        length2 = np.maximum(x * x + y * y + z * z, np.float32(1e-9))
        self._step = shapes.reach_m.astype(np.float32)[:, None] / np.sqrt(length2)
        self._depth = -(x * self._eye[0] + y * self._eye[1] + z * self._eye[2]) / length2
        self._search(self._step, RAY_SAMPLES)
        self._step *= np.float32(0.75 / (RAY_SAMPLES - 1))

    def _search(self, step: Float32Array, samples: int) -> None:
        """Find the point in each ray's free part that is nearest to the shape, or deepest in it, within a depth of
        `step`, (n, rays), from the last one."""
        eye = self._eye - self.moved.T[:, :, None].astype(np.float32)
        x, y, z = self._rays
        depths = self._depth + np.linspace(-1.0, 1.0, samples, dtype=np.float32)[:, None, None] * step
        np.minimum(depths, self._free_to, out=depths)
        distance = self._solids.distance(depths * x + eye[0], depths * y + eye[1], depths * z + eye[2])
        best, self._depth = distance[0], depths[0]
        for other, depth in zip(distance[1:], depths[1:], strict=True):
            nearer = other < best
            best = np.where(nearer, other, best)
            self._depth = np.where(nearer, depth, self._depth)

    def settle(self, iterations: int, settled_m: float) -> tuple[FloatArray, FloatArray]:
        """Step until each fit moves by less than `settled_m`, at most so many times. Returns how far each moved in all, m,
        (n, 3), and its mean misfit, (n,)."""
        moved, misfit = self.moved.copy(), np.zeros(len(self.moved))
        left = np.arange(len(moved))
        for iteration in range(iterations):
            move = self._move()
            going = np.abs(move).max(axis=1) >= settled_m
            if iteration == iterations - 1:
                going[:] = False
            if going.all():
                continue
            done = left[~going]
            moved[done], misfit[done] = self.moved[~going], self._misfit(~going)
            if len(done) == len(left):
                break
            left = left[going]
            self._keep(going)
        return moved, misfit

    def _misfit(self, chosen: BoolArray) -> FloatArray:
        """Mean misfit of some of the fits before the last step, (m,)."""
        size = self._size[chosen]
        loss = np.where(size < HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER))
        misfit: FloatArray = loss.sum(axis=1) / self._count[chosen]
        return misfit

    def _move(self) -> FloatArray:
        """Make one step. Returns the moves, m, (n, 3)."""
        self._search(self._step, 3)
        self._at[:, :, -self._depth.shape[1] :] = self._depth * self._rays + self._eye
        offsets = self._at - self.moved.T[:, :, None].astype(np.float32)
        distance, along = self._solids.gradient(*offsets)
        # A ray that meets the shape is no evidence, nor is a free one that does not.
        missed = distance[:, -self._side.shape[1] :]
        missed *= self._side
        np.maximum(missed, 0, out=missed)
        missed *= self._side
        self._size = np.abs(distance) * self._certainty
        weight = self._certainty2 / np.maximum(self._size, np.float32(HUBER))
        weight *= distance != 0
        weighted = (along * weight).transpose(1, 0, 2)
        curvature = (weighted @ along.transpose(1, 2, 0)).astype(np.float64) + PRIOR
        pull = (weighted @ distance[:, :, None]).astype(np.float64) - PRIOR @ self.moved[:, :, None]
        move: FloatArray = np.linalg.solve(curvature, pull)[..., 0]
        self.moved += move
        return move

    def _keep(self, going: BoolArray) -> None:
        """Go on with some of the fits only, (n,)."""
        self._solids = self._solids.of(going)
        for name in ("moved", "_count", "_side", "_certainty", "_certainty2", "_free_to", "_step", "_depth"):
            setattr(self, name, getattr(self, name)[going])
        for name in ("_at", "_rays", "_eye"):
            setattr(self, name, getattr(self, name)[:, going])
