"""Recent events are counted for a while and then forgotten."""

from __future__ import annotations

from cocoro.clock import NS
from cocoro.health import Recent


def test_amounts_add_up_and_leave_the_window() -> None:
    recent = Recent(window_s=10.0)
    recent.add(3, 1 * NS)
    recent.add(4, 5 * NS)
    recent.add(0, 6 * NS)
    assert recent.total(6 * NS) == 7
    assert recent.total(12 * NS) == 4
    assert recent.total(16 * NS) == 0


def test_a_clock_that_begins_anew_begins_the_count_anew() -> None:
    recent = Recent()
    recent.add(3, 100 * NS)
    assert recent.total(1 * NS) == 0
