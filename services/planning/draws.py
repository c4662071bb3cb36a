"""What babbling tries: Sobol draws, each known by its number, so that a babbling goes on where an earlier one ended."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy  # which loads its parts when they are needed: half a second for this one

from cocoro.arrays import FloatArray


def sobol(first: int, ranges: FloatArray) -> Iterator[tuple[int, FloatArray]]:
    """(number, point) from the draw `first` on, for ever; points (n,) within `ranges` (n, 2). Equal numbers, equal
    points. Number 0, the sequence's own first, is a corner of the box like any other."""
    engine = scipy.stats.qmc.Sobol(len(ranges), scramble=False)
    if first:
        engine.fast_forward(first)
    low, high = ranges.T
    number = first
    while True:
        # Two at a time: the engine warns of a first draw alone, which would not be balanced.
        for share in engine.random(2):
            yield number, np.asarray(low + share * (high - low))
            number += 1
