"""How often, and how evenly, the wheels were commanded."""

from __future__ import annotations

from itertools import pairwise

import msgspec

from cocoro.clock import NS
from cocoro.health import quantile


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
    apart_ms = sorted((later - earlier) / 1e6 for earlier, later in pairwise(stamps_ns))
    return CommandPeriods(
        rate_hz=round((len(stamps_ns) - 1) * NS / (stamps_ns[-1] - stamps_ns[0]), 2),
        median_ms=round(quantile(apart_ms, 0.5), 3),
        p99_ms=round(quantile(apart_ms, 0.99), 3),
        longest_ms=round(apart_ms[-1], 3),
    )
