"""Fits upright known shapes to the evidence of where they are, all objects of a frame at once.

Gauss-Newton on signed distances with Huber weights. Residuals: a surface point's distance from the shape, over its
depth's standard deviation; the distance by which a ray of the outline misses the shape; the depth by which a free ray
beside it enters the shape. The latter two are one-sided. Derived.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np

from cocoro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from services.perception.image import Evidence
from services.perception.region import depth_doubt_m
from services.perception.shapes import Shapes, Solids

ITERATIONS = 12
SETTLED_M = 3e-4
PRIOR = np.eye(3) / 0.05**2
"""Inverse covariance of the first guess, 1/m2: it may be 5 cm off and decides only what the evidence leaves open."""
RAY_SAMPLES = 5
RAY_DOUBT_M, RAY_DOUBT_RAD = 0.001, 0.002
"""Standard deviation of the outline: a constant, and about a pixel at the object's distance."""
SMOOTHED_DOUBT = 0.7
"""Standard deviation of a surface point's depth, the mean of up to nine pixels, relative to that of one pixel. The mean
does not reduce what neighbours have in common: quantisation, and the grain of the sensor's pattern."""
COARSE, COARSE_ITERATIONS, COARSE_SETTLED_M = 3, 4, 1e-3
"""First every third piece of evidence is fitted, in so many steps at most, until the centre settles to a millimetre."""
HUBER = 1.5


def fit_centres(
    shapes: Shapes, evidence: Sequence[Evidence], pose: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The centre of each object's upright shape that fits its evidence best, body frame, m, shape (n, 3), and its mean
    misfit, shape (n,).

    `pose` is the camera's pose in the body frame, 4 x 4; `start` the first guesses, m, shape (n, 3).
    """
    fits = _Fits(shapes, evidence, pose[:3, :3], start - pose[:3, 3])
    # Most of the way by a part of the evidence, which takes a part of the time.
    nearby = fits.part(COARSE)
    moved = nearby.settle(COARSE_ITERATIONS, COARSE_SETTLED_M)[0]
    fits.moved[:] = moved
    moved, misfit = fits.settle(ITERATIONS, SETTLED_M)
    wandered = np.linalg.norm(moved, axis=1) >= 2 * shapes.reach_m
    moved[wandered] = 0.0
    return start + moved, misfit


class _Fits:
    """Fits under way, n of them, in step. Lengths are m, relative to the first guess, in the body's axes.

    Each row of the arrays (n, k) is one fit's evidence: points on the surface, then rays of the outline, then free
    rays, then fill, which counts nothing.
    """

    def __init__(self, shapes: Shapes, evidence: Sequence[Evidence], rotation: FloatArray, guess: FloatArray) -> None:
        """`rotation` (3, 3) turns the camera's axes into the body's; `guess` (n, 3) is relative to the camera."""
        self._solids = Solids(shapes)
        self.moved = np.zeros_like(guess)
        kinds = [[getattr(each, name) for each in evidence] for name in ("surface_m", "outline", "beside")]
        counts = np.array([[len(part) for part in kind] for kind in kinds])
        self._pieces = counts.sum(axis=0)
        points = int(counts[0].max())
        rays = int((counts[1] + counts[2]).max())
        width = points + rays
        origin = np.arange(len(guess)) * width
        column = [
            _runs(origin, counts[0]),
            _runs(origin + points, counts[1]),
            _runs(origin + points + counts[1], counts[2]),
        ]
        place = np.concatenate(column)
        turned = np.concatenate([part for kind in kinds for part in kind]) @ rotation.T
        seen = len(column[0])
        owner = np.repeat(np.arange(len(guess)), counts[0])
        ray_doubt = RAY_DOUBT_M + RAY_DOUBT_RAD * (guess @ rotation[:, 2])
        depth = np.concatenate([each[:, 2] for each in kinds[0]])
        turned[:seen] -= guess[owner]
        self._at = np.zeros((3, len(guess), width), dtype=np.float32)
        self._at.reshape(3, -1)[:, place] = turned.T
        self._certainty = np.repeat(1 / ray_doubt, width).astype(np.float32)
        self._certainty[column[0]] = 1 / (SMOOTHED_DOUBT * depth_doubt_m(depth))
        self._certainty = self._certainty.reshape(-1, width)
        self._certainty2 = self._certainty * self._certainty * np.float32(HUBER)
        self._least, self._greatest = np.zeros((2, len(guess) * width), dtype=np.float32)
        self._least[column[0]] = self._least[column[2]] = -np.inf
        self._greatest[column[0]] = self._greatest[column[1]] = np.inf
        self._least, self._greatest = self._least.reshape(-1, width), self._greatest.reshape(-1, width)
        free_to = np.full(len(guess) * width, np.inf, dtype=np.float32)
        free_to[column[2]] = np.concatenate([each.free_to_m for each in evidence])
        self._free_to = free_to.reshape(-1, width)[:, points:]
        self._rays = self._at[:, :, points:].copy()
        self._eye = -guess.T[:, :, None].astype(np.float32)
        length2 = np.maximum((self._rays * self._rays).sum(axis=0), np.float32(1e-9))
        self._step = shapes.reach_m.astype(np.float32)[:, None] / np.sqrt(length2)
        self._depth = -(self._rays * self._eye).sum(axis=0) / length2
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

    def part(self, every: int) -> _Fits:
        """The same fits with every so many pieces of the evidence."""
        some = copy(self)
        some.moved = self.moved.copy()
        for name in ("_certainty", "_certainty2", "_least", "_greatest", "_free_to", "_step", "_depth", "_at", "_rays"):
            setattr(some, name, getattr(self, name)[..., ::every].copy())
        return some

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
        misfit: FloatArray = loss.sum(axis=1) / self._pieces[chosen]
        return misfit

    def _move(self) -> FloatArray:
        """Make one step. Returns the moves, m, (n, 3)."""
        self._search(self._step, 3)
        self._at[:, :, -self._depth.shape[1] :] = self._depth * self._rays + self._eye
        offsets = self._at - self.moved.T[:, :, None].astype(np.float32)
        distance, along = self._solids.gradient(*offsets)
        np.maximum(distance, self._least, out=distance)
        np.minimum(distance, self._greatest, out=distance)
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
        for name in ("moved", "_pieces", "_certainty", "_certainty2", "_least", "_greatest", "_free_to", "_step", "_depth"):
            setattr(self, name, getattr(self, name)[going])
        for name in ("_at", "_rays", "_eye"):
            setattr(self, name, getattr(self, name)[:, going])


def _runs(first: IntArray, count: IntArray) -> IntArray:
    """The numbers from each of `first` on, as many as `count` says; both (n,)."""
    ends = np.cumsum(count)
    numbers: IntArray = np.arange(ends[-1]) + np.repeat(first - (ends - count), count)
    return numbers
