"""The paper's learning rule and its rule for outliers, and the folds of a cross-validation."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import scipy

from cocoro.arrays import BoolArray, FloatArray, IntArray
from cocoro.learning.network import HyperplaneRbf

_BLOCK = 128
"""Samples computed at a time."""
NEIGHBOUR_M = 0.025
"""The paper's limit: a sighting whose nearest neighbour is further away is an outlier."""
SPARSE_FACTOR = 4.0


def learn_in_order(
    network: HyperplaneRbf, inputs: FloatArray, targets: FloatArray, rate: float, *, by_length: bool = False
) -> None:
    """The paper's rule: learns each sample once, in order. Changes the network. Inputs (b, n), targets (b, k).

    With `by_length` each step is divided by |phi|^2, so that it removes the share `rate` of the sample's error (the
    normalised least mean squares rule, Nagumo and Noda 1967).

    Block by block, exactly as sample by sample: with G the Gram matrix of a block's features and R the steps' rates on
    a diagonal, the errors E that the rule meets one after the other are the solution of the triangular system
    (I + tril(G R, -1)) E = T - Phi W, and the weights then gain Phi' R E (derived).
    """
    for start in range(0, len(inputs), _BLOCK):
        phi = network.features(inputs[start : start + _BLOCK])
        gram = phi @ phi.T
        rates = rate / gram.diagonal() if by_length else np.full(len(phi), rate)
        before = targets[start : start + _BLOCK] - phi @ network.weights
        system = np.tril(gram * rates, -1)
        np.fill_diagonal(system, 1.0)
        errors = scipy.linalg.solve_triangular(system, before, lower=True, unit_diagonal=True, check_finite=False)
        network.weights += phi.T @ (errors * rates[:, None])


def folds(groups: IntArray, count: int) -> Iterable[tuple[BoolArray, BoolArray]]:
    """`count` pairs of masks (learn (b,), check (b,)) with whole groups in each, so that no checked sample is near a
    learned one. `groups` (b,): the group of each sample."""
    names = np.unique(groups)
    for number in range(count):
        check = np.isin(groups, names[number::count])
        yield ~check, check


def inliers(places_m: FloatArray, limit_m: float = NEIGHBOUR_M) -> BoolArray:
    """Mark the positions (b, 3), m, that have a neighbour within the limit; returns shape (b,).

    The paper's 2.5 cm assume dense sightings. The limit is at least four times the median distance of neighbours (own
    addition), since otherwise most of few sightings would be outliers.
    """
    if len(places_m) < 2:
        return np.ones(len(places_m), dtype=np.bool_)
    nearest = np.asarray(scipy.spatial.KDTree(places_m).query(places_m, k=2)[0])[:, 1]
    return np.asarray(nearest <= max(limit_m, SPARSE_FACTOR * float(np.median(nearest))))


def plausible(errors_m: FloatArray, limit: float = 6.0) -> BoolArray:
    """Mark the errors (b, 3) of a map, m, that are at most `limit` times their median length; returns shape (b,).

    It finds a wrong sighting among good ones, which has near neighbours.
    """
    size = np.linalg.norm(errors_m, axis=1)
    return np.asarray(size <= limit * float(np.median(size)))
