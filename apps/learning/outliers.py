"""Sightings that cannot be the hand: those that no other sighting is near to (the paper's rule)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from cocoro.arrays import BoolArray, FloatArray

NEIGHBOUR_M = 0.025
"""The paper's: a sighting whose nearest neighbour is further away is an outlier."""
SPARSE_FACTOR = 4.0


def inliers(places_m: FloatArray, limit_m: float = NEIGHBOUR_M) -> BoolArray:
    """Which of the places (b, 3) have a neighbour within the limit; shape (b,).

    The paper's 2.5 cm supposes sightings that lie densely. Where they do not, most of them would be outliers; so the
    limit is never less than four times the median distance of neighbours (ours).
    """
    if len(places_m) < 2:
        return np.ones(len(places_m), dtype=np.bool_)
    nearest = np.asarray(KDTree(places_m).query(places_m, k=2)[0])[:, 1]
    return np.asarray(nearest <= max(limit_m, SPARSE_FACTOR * float(np.median(nearest))))


def plausible(errors_m: FloatArray, limit: float = 6.0) -> BoolArray:
    """Which of the errors (b, 3) of a map are of the usual size; shape (b,). Usual is up to `limit` times their median
    length: a wrong sighting in the midst of good ones has near neighbours and is found only so."""
    size = np.linalg.norm(errors_m, axis=1)
    return np.asarray(size <= limit * float(np.median(size)))
