"""A test that uses something without its marker fails, also when the code under test hides that."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
TESTS = """
import contextlib, subprocess, sys
import moderngl, pytest, zenoh
import sim.bullet

def start():
    subprocess.run([sys.executable, "-S", "-c", ""], check=True)

@pytest.fixture(scope="module")
def started():
    start()

def test_starts(): start()
def test_starts_in_secret():
    with contextlib.suppress(BaseException): start()
def test_starts_in_a_fixture(started): pass
def test_opens(): zenoh.open(None)
def test_simulates(): sim.bullet.Bullet()
def test_draws(): moderngl.create_context(standalone=True)

@pytest.mark.process
def test_starts_by_right(): start()
def test_computes(): assert 1 + 1 == 2
"""


@pytest.mark.process
def test_a_test_needs_the_marker_of_what_it_uses(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["tiers"]\n')
    (tmp_path / "test_it.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n  process\n  sim\n  zenoh\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--tb=line", "-rA"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": os.pathsep.join((str(HERE), str(HERE.parent)))},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    lines = [line.split() for line in done.stdout.splitlines()]
    words = [each for each in lines if each and each[0] in ("PASSED", "FAILED", "ERROR")]
    ends = {name.partition("::")[2]: end for end, name, *_ in words}
    passed = {name for name, end in ends.items() if end == "PASSED"}
    assert passed == {"test_starts_by_right", "test_computes"}, done.stdout
    assert len(ends) == 8
    for marker, count in {"process": 3, "zenoh": 1, "sim": 2}.items():
        assert done.stdout.count(f"needs the marker `{marker}`") >= count
