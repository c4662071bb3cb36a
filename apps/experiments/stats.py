"""What many runs say together."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Literal, NamedTuple

import numpy as np
from scipy.stats import t as student

Best = Literal["low", "high", "zero"]


class Summary(NamedTuple):
    """Of one measure over the seeds."""

    mean: float
    ci95: float
    """Half the width of the mean's 95% confidence interval (Student's t); NaN with fewer than two values."""
    worst: float
    runs: int
    sd: float = float("nan")
    median: float = float("nan")


def summarise(values: Sequence[float], *, best: Best = "low") -> Summary:
    """`best`: which values are good ones: 'low', 'high', or those near 'zero'. Values that are NaN are left out."""
    kept = np.array([value for value in values if value == value], dtype=np.float64)
    if not len(kept):
        nan = float("nan")
        return Summary(nan, nan, nan, 0)
    worst = kept[np.abs(kept).argmax()] if best == "zero" else kept.max() if best == "low" else kept.min()
    sd = float(kept.std(ddof=1)) if len(kept) > 1 else float("nan")
    ci95 = float(student.ppf(0.975, len(kept) - 1)) * sd / sqrt(len(kept)) if len(kept) > 1 else float("nan")
    return Summary(float(kept.mean()), ci95, float(worst), len(kept), sd, float(np.median(kept)))
