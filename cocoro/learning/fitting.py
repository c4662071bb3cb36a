"""Recursive least squares on a network's weights, one sample at a time or many at once."""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cocoro.arrays import FloatArray
from cocoro.learning.network import HyperplaneRbf


class LeastSquares:
    """Regularised least squares on a network's weights, one sample at a time (recursive least squares) or many at once.

    The network's weights at the start are the prior mean; `doubt` is the variance of each weight about it as a
    multiple of a sample's own variance, so 1 / doubt is the ridge. One by one or all at once, the weights are the same
    (up to rounding). Derived: standard recursive least squares, after Kalman's filter with a static state.
    """

    def __init__(self, network: HyperplaneRbf, doubt: float = 100.0) -> None:
        self.network = network
        count = len(network.weights)
        self._covariance = doubt * np.eye(count)
        """P: of the weights, in units of a sample's variance."""

    def copy(self, network: HyperplaneRbf) -> LeastSquares:
        """A learner that knows as much, for a copy of the network."""
        other = copy(self)
        other.network = network
        other._covariance = self._covariance.copy()
        return other

    def add(self, x: FloatArray, target: FloatArray) -> FloatArray:
        """One sample: input (n,), target (k,). Returns the error before it was learned, (k,)."""
        phi = self.network.features(x[None])[0]
        gain = self._covariance @ phi
        step = gain / (1.0 + float(phi @ gain))
        error: FloatArray = target - phi @ self.network.weights
        self._covariance -= np.multiply.outer(gain, step)
        self.network.weights += np.multiply.outer(step, error)
        return error

    def add_all(self, inputs: FloatArray, targets: FloatArray, weight: float | FloatArray = 1.0) -> None:
        """Samples (b, n) and (b, k) at once; `weight` counts each, or all of them alike, as so many."""
        phi = self.network.features(inputs)
        scale = np.broadcast_to(np.asarray(weight, dtype=np.float64), len(phi))
        information = np.linalg.inv(self._covariance)
        scaled = phi * scale[:, None]
        self._covariance = _symmetric(np.linalg.inv(information + scaled.T @ phi))
        errors = targets - phi @ self.network.weights
        self.network.weights += self._covariance @ (scaled.T @ errors)


def _symmetric(matrix: NDArray[Any]) -> FloatArray:
    return np.asarray((matrix + matrix.T) / 2)
