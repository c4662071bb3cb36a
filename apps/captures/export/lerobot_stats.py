"""The statistics of a LeRobot dataset: least, greatest, mean, deviation and quantiles of each feature."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cocoro.arrays import ImageArray, IntArray

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
SAMPLED_PICTURES = 100
"""Of an episode so many pictures are looked at, or all where it has fewer than twice as many."""
SAMPLED_PX = 150
"""Of a larger picture every nth pixel is looked at, so that about so many are left along its longer side."""
LEVELS = 256

Stats = dict[str, Any]
"""Numbers by the statistic's name, as nested lists."""


def of_values(values: NDArray[Any]) -> Stats:
    """Statistics of each column, exact; of shape (rows,) or (rows, columns), with at least one row."""
    table = values.reshape(len(values), -1).astype(np.float64)
    found: Stats = {
        "min": table.min(axis=0).tolist(),
        "max": table.max(axis=0).tolist(),
        "mean": table.mean(axis=0).tolist(),
        "std": table.std(axis=0).tolist(),
        "count": [len(table)],
    }
    for name, row in zip(QUANTILES, np.quantile(table, [*QUANTILES.values()], axis=0), strict=True):
        found[name] = row.tolist()
    return found


class PictureStats:
    """Counts the levels of each colour, of which statistics of pictures are made; parts can be added up."""

    def __init__(self) -> None:
        self.pictures = 0
        self._counts: IntArray = np.zeros((3, LEVELS), np.int64)

    def see(self, picture: ImageArray) -> None:
        step = max(1, max(picture.shape[:2]) // SAMPLED_PX)
        seen = picture[::step, ::step]
        for colour in range(3):
            self._counts[colour] += np.bincount(seen[..., colour].ravel(), minlength=LEVELS)
        self.pictures += 1

    def add(self, other: PictureStats) -> None:
        self.pictures += other.pictures
        self._counts += other._counts

    def stats(self) -> Stats:
        """Statistics of each colour in [0, 1], of shape (3, 1, 1); at least one picture was seen."""
        levels = np.arange(LEVELS) / (LEVELS - 1)
        reached = np.cumsum(self._counts, axis=1)
        total = reached[:, -1]
        mean = self._counts @ levels / total
        deviation = np.sqrt(np.maximum(self._counts @ levels**2 / total - mean**2, 0.0))
        rows = {
            "min": levels[np.argmax(reached > 0, axis=1)],
            "max": levels[np.argmax(reached >= total[:, None], axis=1)],
            "mean": mean,
            "std": deviation,
        }
        for name, share in QUANTILES.items():
            rows[name] = levels[np.argmax(reached >= share * total[:, None], axis=1)]
        return {name: row.reshape(3, 1, 1).tolist() for name, row in rows.items()} | {"count": [self.pictures]}
