"""How often, and how evenly, the wheels were commanded."""

from __future__ import annotations

from itertools import pairwise

import msgspec
import numpy as np

from cocoro.clock import NS


class CommandPeriods(msgspec.Struct, frozen=True, kw_only=True):
    """Periods between successive wheel commands, by their stamps."""

    rate_hz: float
    median_ms: float
    p99_ms: float
    longest_ms: float


def command_periods(stamps_ns: list[int]) -> CommandPeriods | None:
    """The periods between the stamps of commands, in order; None for fewer than two commands or no time between."""
    if len(stamps_ns) < 2 or stamps_ns[-1] <= stamps_ns[0]:
        return None
    apart_ms = np.array([(later - earlier) / 1e6 for earlier, later in pairwise(stamps_ns)])
    median, p99 = np.percentile(apart_ms, (50, 99))
    return CommandPeriods(
        rate_hz=round((len(stamps_ns) - 1) * NS / (stamps_ns[-1] - stamps_ns[0]), 2),
        median_ms=round(float(median), 3),
        p99_ms=round(float(p99), 3),
        longest_ms=round(float(apart_ms.max()), 3),
    )
