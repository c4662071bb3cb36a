"""When a stamp of the simulated robot was, by the clock that all processes of this machine share."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path

from sim.motion import MotionRow, read_motion


class StampClock:
    """Converts simulated stamps to CLOCK_MONOTONIC by the simulator's record of its steps (setting `motion`)."""

    def __init__(self, rows: Sequence[MotionRow]) -> None:
        self._rows = rows

    @classmethod
    def of_file(cls, file: Path) -> StampClock:
        """From the record, as far as it is written."""
        return cls(read_motion(file))

    def real_ns(self, stamp_ns: int) -> int:
        """CLOCK_MONOTONIC at a stamp, between two steps by interpolation. Raises ValueError for one that the record
        does not reach."""
        above = bisect_left(self._rows, stamp_ns, key=lambda row: row.sim_ns)
        if not 0 < above < len(self._rows):
            raise ValueError(f"the record of the motion has no stamp {stamp_ns}")
        before, after = self._rows[above - 1], self._rows[above]
        share = (stamp_ns - before.sim_ns) / (after.sim_ns - before.sim_ns)
        return before.real_ns + round(share * (after.real_ns - before.real_ns))
