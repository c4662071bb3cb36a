"""The paper's learning rule, and the folds of a cross-validation."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import scipy

from cocoro.arrays import BoolArray, FloatArray, IntArray
from cocoro.learning.network import HyperplaneRbf

_BLOCK = 128


def learn_in_order(network: HyperplaneRbf, inputs: FloatArray, targets: FloatArray, rate: float) -> None:
    """The paper's rule: each sample once, in order. Changes the network. inputs (b, n), targets (b, k).

    Block by block, exactly as sample by sample: with G the Gram matrix of a block's features, the errors E that the
    rule meets one after the other are the solution of the triangular system (I + rate tril(G, -1)) E = T - Phi W, and
    the weights then gain rate Phi' E (derived).
    """
    for start in range(0, len(inputs), _BLOCK):
        phi = network.features(inputs[start : start + _BLOCK])
        before = targets[start : start + _BLOCK] - phi @ network.weights
        system = np.tril(rate * (phi @ phi.T), -1)
        np.fill_diagonal(system, 1.0)
        errors = scipy.linalg.solve_triangular(system, before, lower=True, unit_diagonal=True)
        network.weights += rate * (phi.T @ errors)


def folds(groups: IntArray, count: int) -> Iterable[tuple[BoolArray, BoolArray]]:
    """`count` pairs of boolean masks (learn, check), whole groups in each: what is checked was never near to what was
    learned. `groups` (b,) tells which samples belong together."""
    names = np.unique(groups)
    for number in range(count):
        check = np.isin(groups, names[number::count])
        yield ~check, check
