"""What the tests take: from the record of a run, and what is kept of it."""

from __future__ import annotations

import json
from pathlib import Path

from run_known import KEPT, LARGE_MB, kept, recorded, to_keep
from run_memory import LEAST_MB, MEMORY

TESTS = Path(__file__).parent


def record(folder: Path) -> None:
    first = {
        "files": {"a.py": {"wall_s": 3.0}, "b.py": {"wall_s": 0.2}, "c.py": {"wall_s": 9.0}},
        "tests_s": {"a.py::one": 2.5},
    }
    (folder / "pytest-1.json").write_text(json.dumps(first))
    (folder / "pytest-2.json").write_text(json.dumps({"files": {"b.py": {"wall_s": 0.3}}}))
    needs_mb = {"a.py::one": LARGE_MB + 1.4, "a.py::two": 90.4, "a.py::three": 70.0, "b.py::one": 12.0}
    needs_mb |= {"c.py::one": 500.0, "c.py::two": 600.0, "c.py::three": 100.0}
    (folder / MEMORY).write_text(json.dumps({"own_mb": needs_mb}))


def test_a_record_tells_what_each_test_took_and_else_its_file(tmp_path: Path) -> None:
    assert recorded(tmp_path / "missing") is None
    record(tmp_path)
    known = recorded(tmp_path)
    assert known is not None
    assert known.takes_s(["a.py::one", "a.py::two"]) == 2.5
    assert known.takes_s(["a.py::two"]) == 3.0
    assert known.takes_s(["b.py::one"]) == 0.3
    assert known.takes_s(["d.py::one"]) == 0.0
    assert known.need_mb("a.py::two") == 90.4
    assert known.files == {"a.py", "b.py", "c.py"}


def test_a_run_is_kept_by_file_with_the_tests_that_need_much(tmp_path: Path) -> None:
    record(tmp_path)
    known = recorded(tmp_path)
    assert known is not None
    small = to_keep(known)
    assert small.wall_s == {"a.py": 3.0, "c.py": 9.0}
    assert small.own_mb == {"a.py": 90.0, "a.py::one": LARGE_MB + 1, "b.py": LEAST_MB, "c.py": 600.0}
    assert small.need_mb("a.py::one") == LARGE_MB + 1
    assert small.need_mb("a.py::three") == 90.0


def test_what_is_kept_is_of_files_that_are_there() -> None:
    known = kept()
    assert len(known.files) > 200
    assert [file for file in known.files if not (TESTS.parent / file).is_file()] == []
    assert all(LEAST_MB <= mb < 1500 for mb in known.own_mb.values())
    assert json.loads(KEPT.read_text()).keys() == {"wall_s", "own_mb"}
