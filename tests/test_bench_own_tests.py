"""`python -m bench tests`: the record of the last run of the tests as figures and tables."""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path

import pytest

from bench import own_tests
from bench.report import Report


def measured(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Report:
    monkeypatch.setattr(own_tests, "RECORD", folder)
    report = Report()
    own_tests.measure(Namespace(run=False, short=False), report)
    return report


def part(folder: Path, name: str, **files: dict[str, float]) -> None:
    written = {
        "arguments": ["--spread"],
        "wall_s": 4.0,
        "files": {f"tests/{file}.py": row for file, row in files.items()},
    }
    (folder / f"pytest-{name}.json").write_text(json.dumps(written))


def test_files_are_summed_over_the_parts_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = {"tests": 2, "wall_s": 1.0, "processor_s": 0.5, "memory_mb": 90.0}
    slow = {"tests": 1, "wall_s": 9.0, "processor_s": 7.0, "memory_mb": 70.0}
    part(tmp_path, "1", a=quick)
    part(tmp_path, "2", a=slow, b=quick)
    (tmp_path / "seconds").write_text("12\n")
    (tmp_path / "memory.json").write_text(
        json.dumps(
            {
                "peak_mb": 800.0,
                "at_s": 3.0,
                "looks": [[1.0, 700.0, {"tests/a.py - one": 650.0}], [3.0, 800.0, {"tests/b.py": 500.0, "rest": 90.0}]],
                "idle_s": [0.5, 1.5],
                "largest": [["x", 500.0, "tests/b.py"]],
            }
        )
    )
    report = measured(tmp_path, monkeypatch)
    found = {figure.name: figure for figure in report.figures}
    assert found["all tests"].median == 12.0
    assert found["memory of all their processes, at its peak"].median == 800.0
    assert all(figure.kept for figure in report.figures)
    assert found["processor time of the tests and of what they waited for"].median == 8.0
    files, largest, over_time = report.tables
    assert files.rows == [["a.py", "3", "10.0", "7.5", "90"], ["b.py", "2", "1.0", "0.5", "90"]]
    assert largest.rows == [["x", "tests/b.py", "500"]]
    assert over_time.rows == [["0", "800", "0.5", "b.py 500, rest 90"]]
    assert found["processor time that nobody used"].median == 1.0


def test_a_run_that_took_too_long_or_too_much_memory_misses_its_bounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part(tmp_path, "1", a={"tests": 1, "wall_s": 1.0, "processor_s": 1.0, "memory_mb": 1.0})
    (tmp_path / "seconds").write_text("361\n")
    (tmp_path / "memory.json").write_text(json.dumps({"peak_mb": 1001.0, "at_s": 3.0, "looks": [], "largest": []}))
    missed = [figure.name for figure in measured(tmp_path, monkeypatch).figures if not figure.kept]
    assert missed == ["all tests", "memory of all their processes, at its peak"]


def test_without_a_record_it_says_how_to_get_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report = measured(tmp_path / "missing", monkeypatch)
    assert report.figures == []
    assert "make test" in report.notes[0]
