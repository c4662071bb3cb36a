"""Faults of every kind at random moments of a moving robot: a few trials of `python -m bench hardware-faults`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from bench import hardware_faults
from bench.report import Result, decode

pytestmark = pytest.mark.process

COUNT = 16
SLOWEST_MS = 800.0
"""Time in which the wheels must stand: 0.3 s, plus what a busy machine adds."""


def bench(name: str, *arguments: str) -> tuple[Result, dict[str, float]]:
    """The result of a bench, and its figures by name."""
    command = [sys.executable, "-m", "bench", name, *arguments, "--json"]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, timeout=240, check=False)
    assert done.stdout, done.stderr.decode()
    result = decode(done.stdout, "the bench's output")
    return result, {figure.name: figure.median for figure in result.figures}


def test_no_fault_crashes_moves_the_wrong_way_or_stays() -> None:
    result, figures = bench("hardware-faults", "--count", str(COUNT), "--seed", "3")
    assert figures[hardware_faults.TRIED] == COUNT
    wrong = [figures[name] for name in (hardware_faults.CRASHES, hardware_faults.WRONG, hardware_faults.STUCK)]
    assert wrong == [0, 0, 0], result
    assert figures[hardware_faults.SLOWEST] < SLOWEST_MS, result


def test_the_parsers_take_whatever_comes() -> None:
    result, _ = bench("fuzz", "--seconds", "3")
    assert result.kept
