"""Freed memory: kept in the process while that is faster, and given back when it is asked for."""

from __future__ import annotations

import subprocess
import sys

import pytest

HOLES = """
from pathlib import Path
from cocoro.heap import give_back, keep_freed

def held_kb():
    status = Path("/proc/self/smaps_rollup").read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("Private_Dirty"))

assert keep_freed()
blocks = [bytes([number % 255 + 1]) * 100_000 for number in range(400)]
kept = blocks[::20]
del blocks
before_kb = held_kb()
assert give_back()
print(before_kb - held_kb(), len(kept))
"""
"""40 MB, of which a twentieth stays in use."""


@pytest.mark.process
def test_memory_that_was_freed_between_what_is_in_use_goes_back() -> None:
    said = subprocess.run([sys.executable, "-c", HOLES], capture_output=True, text=True, check=True).stdout
    given_kb, kept = map(int, said.split())
    assert kept == 20
    assert given_kb > 25_000, said
