"""Faults of every kind at random moments of a moving robot: a few trials of `python -m bench.hardware_faults`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

COUNT = 16
SLOWEST_MS = 800.0
"""Time in which the wheels must stand: 0.3 s, plus what a busy machine adds."""


def bench(name: str, *arguments: str) -> str:
    command = [sys.executable, "-m", f"bench.{name}", *arguments]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[1], capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_no_fault_crashes_moves_the_wrong_way_or_stays() -> None:
    tallies = json.loads(bench("hardware_faults", "--count", str(COUNT), "--seed", "3", "--json"))
    assert sum(tally["tried"] for tally in tallies.values()) == COUNT
    for name, tally in tallies.items():
        assert (tally["crashes"], tally["wrong"], tally["stuck"]) == (0, 0, 0), f"{name}: {tally}"
        assert tally["slowest_stop_ms"] < SLOWEST_MS, name


def test_the_parsers_take_whatever_comes() -> None:
    assert "nothing but clean rejections" in bench("fuzz", "--seconds", "3")
