"""The hyperplane radial basis function network (Guenther and Micci Barreca 1997), and its exact Jacobian.

Inputs x (n), centres mu_j (m of them), widths sigma (n): c_j = (x - mu_j) / sigma, g_j = exp(-|c_j|^2 / 2),
h_j = g_j / sum g, y_k = sum_j h_j (w_kj + sum_i v_kji c_ji). Linear in its weights: with the features
phi = (h_1 .. h_m, h_1 c_11 .. h_m c_mn), y = phi W. Equations: the design's, derived where the paper's were lost.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cocoro.arrays import FloatArray

PAPER_RANGE_RAD = 2.62
PAPER_BASES = 3
"""A joint; 81 for the arm's four."""
PAPER_WIDTH_RAD = 1.57
PAPER_RATE = 0.025


class HyperplaneRbf:
    """A network of `centres` (m, n) and `widths_rad` (n,) with `outputs` outputs, that begins as zero everywhere."""

    def __init__(self, centres: FloatArray, widths: FloatArray, outputs: int) -> None:
        self.centres = np.ascontiguousarray(centres, dtype=np.float64)
        self.widths = np.asarray(widths, dtype=np.float64)
        count, inputs = self.centres.shape
        if self.widths.shape != (inputs,) or (self.widths <= 0).any():
            raise ValueError(f"{inputs} positive widths are needed, not {widths}")
        self._scale = 1.0 / self.widths
        self._minus_half = np.full(inputs, -0.5)
        self.weights = np.zeros((count * (1 + inputs), outputs))
        """W, shape (m (1 + n), k): first the w of every basis, then the v, basis by basis."""

    @classmethod
    def spread(
        cls, bases: Sequence[int], widths: Sequence[float], ranges: FloatArray, outputs: int = 3
    ) -> HyperplaneRbf:
        """Bases evenly over a box: so many along each input, from its low to its high end (`ranges`, (n, 2)); a single
        one stands in the middle."""
        axes = [
            np.linspace(low, high, count) if count > 1 else np.array([(low + high) / 2])
            for count, (low, high) in zip(bases, ranges, strict=True)
        ]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        return cls(grid, np.asarray(widths, dtype=np.float64), outputs)

    @classmethod
    def paper(cls, inputs: int = 4, outputs: int = 3) -> HyperplaneRbf:
        """The paper's: 3 bases a joint over +-2.62 rad, sigma 1.57."""
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
        dh_j/dx_i = h_j (sum_l h_l c_li - c_ji) / sigma_i, it is sum_j a_j dh_j/dx + sum_j h_j V_j / sigma."""
        h, c = self._activate_one(x)
        count, inputs = c.shape
        planes = self.weights[count:]
        values = self.weights[:count] + np.matmul(c[:, None, :], planes.reshape(count, inputs, -1))[:, 0]
        slopes = h[:, None] * (h.dot(c) - c)
        jac = values.T.dot(slopes)
        jac += h.dot(planes.reshape(count, -1)).reshape(inputs, -1).T
        return np.asarray(jac * self._scale)

    def learn(self, x: FloatArray, target: FloatArray, rate: float) -> None:
        """The paper's rule on one sample: dw_kj = a (t_k - y_k) h_j, dv_kji = a (t_k - y_k) h_j c_ji."""
        phi = self.features(x[None])[0]
        self.weights += np.multiply.outer(rate * phi, target - phi @ self.weights)

    def copy(self) -> HyperplaneRbf:
        other = HyperplaneRbf(self.centres, self.widths, self.outputs)
        other.weights = self.weights.copy()
        return other

    def _activate_one(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """h (m,) and c (m, n): as `_activate`, but as quick as can be for one input."""
        c = (x - self.centres) * self._scale
        exponent = (c * c).dot(self._minus_half)
        exponent -= exponent.max()
        g = np.exp(exponent, out=exponent)
        return g / g.sum(), c

    def _activate(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """h (b, m) and c (b, m, n)."""
        c = (x[:, None, :] - self.centres) / self.widths
        exponent = -0.5 * np.einsum("bmn,bmn->bm", c, c)
        g = np.exp(exponent - exponent.max(axis=1, keepdims=True))  # far from every centre, the nearest still counts
        return g / g.sum(axis=1, keepdims=True), c
