"""The hyperplane radial basis function network (Guenther and Micci Barreca 1997), its Jacobian, and least squares.

Inputs x (n), centres mu_j (m of them), widths sigma (n): c_j = (x - mu_j) / sigma, g_j = exp(-|c_j|^2 / 2),
y_k = sum_j h_j (w_kj + sum_i v_kji c_ji). The activations h_j are g_j / sum g (normalised) or g_j (plain). Linear in
its weights: with the features phi = (h_1 .. h_m, h_1 c_11 .. h_m c_mn), y = phi W. The paper's text lost its equations;
these are derived, and `apps/learning/paper_rule.py` has every reading that the text allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cocoro.arrays import FloatArray

PAPER_RANGE_RAD = 2.62
PAPER_BASES = 3
"""Bases per joint; 81 for the arm's four joints."""
PAPER_WIDTH_RAD = 1.57
PAPER_RATE = 0.025


class HyperplaneRbf:
    """A network with `centres` (m, n), `widths` (n,) and `outputs` outputs; its weights start at zero.

    Inputs, centres and widths have one unit (radians for joint angles); outputs have that of the targets it learns.
    `normalised`: the activations of all bases add up to one.
    """

    def __init__(self, centres: FloatArray, widths: FloatArray, outputs: int, *, normalised: bool = True) -> None:
        self.centres = np.ascontiguousarray(centres, dtype=np.float64)
        self.widths = np.asarray(widths, dtype=np.float64)
        count, inputs = self.centres.shape
        if self.widths.shape != (inputs,) or (self.widths <= 0).any():
            raise ValueError(f"{inputs} positive widths are needed, not {widths}")
        self.normalised = normalised
        self._scale = 1.0 / self.widths
        self._minus_half = np.full(inputs, -0.5)
        self.weights = np.zeros((count * (1 + inputs), outputs))
        """W, shape (m (1 + n), k): first the w of every basis, then the v, basis by basis."""

    @classmethod
    def spread(
        cls, bases: Sequence[int], widths: Sequence[float], ranges: FloatArray, outputs: int = 3
    ) -> HyperplaneRbf:
        """Bases evenly spaced over a box: `bases` along each input, from low to high end of `ranges` (n, 2). A single
        basis is in the middle."""
        axes = [
            np.linspace(low, high, count) if count > 1 else np.array([(low + high) / 2])
            for count, (low, high) in zip(bases, ranges, strict=True)
        ]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        return cls(grid, np.asarray(widths, dtype=np.float64), outputs)

    @classmethod
    def paper(cls, inputs: int = 4, outputs: int = 3) -> HyperplaneRbf:
        """The paper's network: 3 bases per joint over +-2.62 rad, sigma 1.57 rad."""
        ranges = np.tile([-PAPER_RANGE_RAD, PAPER_RANGE_RAD], (inputs, 1))
        return cls.spread([PAPER_BASES] * inputs, [PAPER_WIDTH_RAD] * inputs, ranges, outputs)

    @property
    def inputs(self) -> int:
        return int(self.centres.shape[1])

    @property
    def bases(self) -> int:
        return int(self.centres.shape[0])

    @property
    def outputs(self) -> int:
        return int(self.weights.shape[1])

    def features(self, x: FloatArray) -> FloatArray:
        """phi for inputs (b, n), shape (b, m (1 + n))."""
        h, c = self._activate(x)
        planes = (h[..., None] * c).reshape(len(x), -1)
        return np.concatenate([h, planes], axis=1)

    def predict(self, x: FloatArray) -> FloatArray:
        """y for inputs (b, n), shape (b, k)."""
        return np.asarray(self.features(x) @ self.weights)

    def at(self, x: FloatArray) -> FloatArray:
        """y for one input (n,), shape (k,)."""
        h, c = self._activate_one(x)
        return np.asarray(h.dot(self.weights[: len(h)]) + (h[:, None] * c).ravel().dot(self.weights[len(h) :]))

    def jacobian(self, x: FloatArray) -> FloatArray:
        """dy/dx at one input (n,), exact, shape (k, n). Derived: with a_j = w_j + V_j c_j the value of plane j and
        dh_j/dx_i = h_j (sum_l h_l c_li - c_ji) / sigma_i, it is sum_j a_j dh_j/dx + sum_j h_j V_j / sigma. Plain
        activations have dh_j/dx_i = -h_j c_ji / sigma_i."""
        h, c = self._activate_one(x)
        count, inputs = c.shape
        planes = self.weights[count:]
        values = self.weights[:count] + np.matmul(c[:, None, :], planes.reshape(count, inputs, -1))[:, 0]
        slopes = h[:, None] * (h.dot(c) - c if self.normalised else -c)
        jac = values.T.dot(slopes)
        jac += h.dot(planes.reshape(count, -1)).reshape(inputs, -1).T
        return np.asarray(jac * self._scale)

    def learn(self, x: FloatArray, target: FloatArray, rate: float) -> None:
        """The paper's rule on one sample: dw_kj = a (t_k - y_k) h_j, dv_kji = a (t_k - y_k) h_j c_ji."""
        phi = self.features(x[None])[0]
        self.weights += np.multiply.outer(rate * phi, target - phi @ self.weights)

    def copy(self) -> HyperplaneRbf:
        other = HyperplaneRbf(self.centres, self.widths, self.outputs, normalised=self.normalised)
        other.weights = self.weights.copy()
        return other

    def _activate_one(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """h (m,) and c (m, n) for one input: a faster `_activate`."""
        c = (x - self.centres) * self._scale
        exponent = (c * c).dot(self._minus_half)
        if not self.normalised:
            return np.exp(exponent, out=exponent), c
        exponent -= exponent.max()
        g = np.exp(exponent, out=exponent)
        return g / g.sum(), c

    def _activate(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """h (b, m) and c (b, m, n)."""
        c = (x[:, None, :] - self.centres) / self.widths
        exponent = -0.5 * np.einsum("bmn,bmn->bm", c, c)
        if not self.normalised:
            return np.exp(exponent), c
        g = np.exp(exponent - exponent.max(axis=1, keepdims=True))  # far from all centres the nearest one decides
        return g / g.sum(axis=1, keepdims=True), c


class LeastSquares:
    """Regularised least squares on a network's weights, one sample at a time or many at once.

    The network's weights at the start are the prior mean. `doubt` is the prior variance of each weight as a multiple of
    a sample's variance, so 1 / doubt is the ridge parameter. Samples one by one and all at once give the same weights
    up to rounding. Source: recursive least squares, which is the Kalman filter of a static state (Kalman 1960).
    """

    def __init__(self, network: HyperplaneRbf, doubt: float = 100.0) -> None:
        self.network = network
        count = len(network.weights)
        self._covariance = doubt * np.eye(count)
        """Covariance of the weights in units of a sample's variance, (m (1 + n), m (1 + n))."""

    def copy(self, network: HyperplaneRbf) -> LeastSquares:
        """A learner in the same state, for a copy of the network."""
        other = copy(self)
        other.network = network
        other._covariance = self._covariance.copy()
        return other

    def add(self, x: FloatArray, target: FloatArray) -> FloatArray:
        """Learns one sample, input (n,) and target (k,). Returns the error before that, (k,), in the target's unit."""
        phi = self.network.features(x[None])[0]
        gain = self._covariance @ phi
        step = gain / (1.0 + float(phi @ gain))
        error: FloatArray = target - phi @ self.network.weights
        self._covariance -= np.multiply.outer(gain, step)
        self.network.weights += np.multiply.outer(step, error)
        return error

    def add_all(self, inputs: FloatArray, targets: FloatArray, weight: float | FloatArray = 1.0) -> None:
        """Learns inputs (b, n) and targets (b, k) at once. Each counts as `weight` samples: (b,), or one for all."""
        phi = self.network.features(inputs)
        scale = np.broadcast_to(np.asarray(weight, dtype=np.float64), len(phi))
        information = np.linalg.inv(self._covariance)
        scaled = phi * scale[:, None]
        self._covariance = _symmetric(np.linalg.inv(information + scaled.T @ phi))
        errors = targets - phi @ self.network.weights
        self.network.weights += self._covariance @ (scaled.T @ errors)


def _symmetric(matrix: NDArray[Any]) -> FloatArray:
    return np.asarray((matrix + matrix.T) / 2)
