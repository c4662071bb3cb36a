"""Captures of earlier versions are read as today's types, by the rules of `cocoro.capture.former`."""

from __future__ import annotations

from pathlib import Path

from apps.captures.info import report
from cocoro.capture.reader import Capture
from cocoro.messages import ClockTick

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"
"""Recorded by an earlier version."""


def test_a_renamed_type_is_read_as_todays() -> None:
    with Capture.open(GOLDEN) as capture:
        ticks = list(capture.messages("sim/clock"))
        schema = capture.schema(ticks[0].channel)
        assert schema is not None
        assert schema.name == "Clock"
        read = [capture.read(tick) for tick in ticks]
        assert all(isinstance(tick, ClockTick) for tick in read)
        (key,) = (key for key in report(capture).keys if key.key.endswith("sim/clock"))
    assert key.changed == ()
