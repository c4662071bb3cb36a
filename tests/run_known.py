"""What each test takes, as measured: its time, and the memory that it needs.

The record of the last run knows it for every test. `known.json` beside this file keeps it by file, for a checkout that
has no record yet and for files that the record lacks; tests that need much memory are in it by themselves. After a
whole run on a machine that does nothing else, `python tests/run_known.py` makes it anew.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from run_memory import LAST, LEAST_MB, MEMORY

KEPT = Path(__file__).parent / "known.json"
LARGE_MB = 400.0
"""Tests that need more are kept one by one, and are a job of their own (`tests/run_room.py`)."""
SHORT_S = 0.5
"""Files that take less are not kept: their order does not matter."""


@dataclass(frozen=True)
class Known:
    """Figures by test, or by file for the tests of it that are not there themselves."""

    wall_s: Mapping[str, float] = field(default_factory=dict)
    own_mb: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def files(self) -> set[str]:
        """Those of which anything is known."""
        return {file_of(name) for name in (*self.wall_s, *self.own_mb)}

    def need_mb(self, test: str) -> float | None:
        """None for a test that is not known."""
        return self.own_mb.get(test, self.own_mb.get(file_of(test)))

    def takes_s(self, tests: Iterable[str]) -> float:
        """The time of tests of one file, s; that of the whole file where they are not known one by one."""
        tests = list(tests)
        known = [self.wall_s[test] for test in tests if test in self.wall_s]
        return sum(known) if known else self.wall_s.get(file_of(tests[0]), 0.0)


def kept(file: Path = KEPT) -> Known:
    """The figures that are in the tree."""
    data = json.loads(file.read_text())
    return Known(data["wall_s"], data["own_mb"])


def recorded(folder: Path | None) -> Known | None:
    """The figures of a record, None where there is none. A test whose memory no look has seen needs the least."""
    if folder is None or not folder.is_dir():
        return None
    wall_s: dict[str, float] = defaultdict(float)
    for part in folder.glob("pytest-*.json"):
        run = json.loads(part.read_text())
        for name, seconds in run.get("tests_s", {}).items():
            wall_s[name] = max(wall_s[name], seconds)
        for name, figures in run["files"].items():
            wall_s[name] = max(wall_s[name], figures["wall_s"])
    own_mb = json.loads((folder / MEMORY).read_text()).get("own_mb", {}) if (folder / MEMORY).is_file() else {}
    return Known(wall_s, own_mb)


def to_keep(known: Known) -> Known:
    """The figures of a record by file. Tests that need much are in it by themselves, unless most of their file do."""
    wall_s = {name: round(took_s, 1) for name, took_s in known.wall_s.items() if "::" not in name and took_s > SHORT_S}
    own_mb = {name: LEAST_MB for name in known.wall_s if "::" not in name}
    by_file: dict[str, dict[str, float]] = defaultdict(dict)
    for name, mb in known.own_mb.items():
        if (file := file_of(name)) in own_mb:
            by_file[file][name] = max(LEAST_MB, float(round(mb)))
    for file, needs_mb in by_file.items():
        large = {name: mb for name, mb in needs_mb.items() if mb > LARGE_MB}
        if len(large) > len(needs_mb) / 2:
            large = {}
        own_mb[file] = max((mb for name, mb in needs_mb.items() if name not in large), default=LEAST_MB)
        own_mb |= large
    return Known(dict(sorted(wall_s.items())), dict(sorted(own_mb.items())))


def file_of(test: str) -> str:
    return test.partition("::")[0]


def main() -> None:
    folder = Path(__file__).parents[1] / "out" / "tests" / LAST
    if (known := recorded(folder)) is None:
        sys.exit("there is no record: run `make test` first")
    new = to_keep(known)
    KEPT.write_text(json.dumps({"wall_s": new.wall_s, "own_mb": new.own_mb}, indent=1) + "\n")


if __name__ == "__main__":
    main()
