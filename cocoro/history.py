"""A history of a state: bounded, ordered by stamp, interpolated, with explicit gaps."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from math import pi

import numpy as np

from cocoro.arrays import FloatArray

DEFAULT_CAPACITY = 256
"""Five seconds of a 50 Hz state."""
DEFAULT_JUMP_BACK_NS = 500_000_000


class History:
    """The newest samples of one state vector, for its value at a given time.

    A sample of another incarnation (its publisher restarted) or with a stamp more than `jump_back_ns` before the newest
    one (its clock began a new epoch) empties the history first. A late or repeated sample is refused.
    """

    def __init__(
        self,
        width: int,
        *,
        angular: Sequence[int] = (),
        capacity: int = DEFAULT_CAPACITY,
        jump_back_ns: int = DEFAULT_JUMP_BACK_NS,
    ) -> None:
        """Vectors have `width` components. The `angular` ones, rad, are unwrapped to within half a turn of the sample
        before, so that interpolation from 179 to -179 degrees does not pass through 0."""
        if capacity < 2:
            raise ValueError(f"a history of {capacity} samples cannot be interpolated")
        self._width = width
        self._angular = list(angular)
        self._capacity = capacity
        self._jump_back_ns = jump_back_ns
        self._incarnation: int | None = None
        self._stamps_ns: list[int] = []
        self._values: list[FloatArray] = []
        self.resets = 0
        """Number of times that a restart or a clock that jumped back emptied it."""
        self.refused = 0
        """Number of late and repeated samples."""

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, stamp_ns: int, values: Sequence[float] | FloatArray, incarnation: int = 0) -> bool:
        """Append `values` (width,); False when the sample is late or repeated. Raises ValueError for a wrong width."""
        vector = np.array(values, dtype=np.float64)
        if vector.shape != (self._width,):
            raise ValueError(f"a vector of {self._width} was expected, not shape {vector.shape}")
        if self._stamps_ns and (
            incarnation != self._incarnation or stamp_ns < self._stamps_ns[-1] - self._jump_back_ns
        ):
            self.clear()
            self.resets += 1
        self._incarnation = incarnation
        if self._stamps_ns:
            if stamp_ns <= self._stamps_ns[-1]:
                self.refused += 1
                return False
            for i in self._angular:
                vector[i] -= 2 * pi * round((vector[i] - self._values[-1][i]) / (2 * pi))
        self._stamps_ns.append(stamp_ns)
        self._values.append(vector)
        if len(self._stamps_ns) > self._capacity:
            del self._stamps_ns[0], self._values[0]
        return True

    def at(self, stamp_ns: int, max_gap_ns: int) -> FloatArray | None:
        """The vector at a time, linearly interpolated between the two samples around it; shape (width,).

        None when the time is outside of the history (nothing is extrapolated) or when the two samples are more than
        `max_gap_ns` apart.
        """
        after = bisect_left(self._stamps_ns, stamp_ns)
        if after == len(self._stamps_ns):
            return None
        if self._stamps_ns[after] == stamp_ns:
            return self._values[after].copy()
        if after == 0:
            return None
        start_ns, end_ns = self._stamps_ns[after - 1], self._stamps_ns[after]
        if end_ns - start_ns > max_gap_ns:
            return None
        share = (stamp_ns - start_ns) / (end_ns - start_ns)
        return (1.0 - share) * self._values[after - 1] + share * self._values[after]

    @property
    def newest(self) -> tuple[int, FloatArray] | None:
        """The last sample, (stamp_ns, vector (width,)); None when there is none."""
        return (self._stamps_ns[-1], self._values[-1].copy()) if self._stamps_ns else None

    @property
    def oldest_ns(self) -> int | None:
        """The stamp of the first sample in the history; None when there is none."""
        return self._stamps_ns[0] if self._stamps_ns else None

    def clear(self) -> None:
        self._stamps_ns.clear()
        self._values.clear()
