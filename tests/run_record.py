"""A record of a whole run of the tests, and their order in the next one.

A pytest plugin. It does nothing unless `COCORO_TESTS_RECORD` names a folder; `deploy/test.sh` does that. Each run of
pytest writes a file there: for each file of tests its wall time, its processor time (with that of the processes that it
waited for) and the memory of pytest itself, and for each test its wall time. The files that took longest in the last
run come first, so that no worker is left with a long one at the end. `python -m bench tests` shows the record.
"""

from __future__ import annotations

import json
import os
import resource
import time
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path

import pytest
from run_known import file_of, kept, recorded
from run_memory import LAST, RUNNING, WORKER

FOLDER = "COCORO_TESTS_RECORD"
"""Environment variable: the folder to write to. Beside it `last` is the folder of the last run."""
FIGURES = ("tests", "wall_s", "processor_s", "memory_mb")


def processor_s() -> float:
    """Processor time of this process and of those of its children that have ended, s."""
    now = os.times()
    return now.user + now.system + now.children_user + now.children_system


def memory_mb() -> float:
    """Resident memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


class Record:
    """With `--spread` the workers measure, and their reports carry it to the process that writes."""

    def __init__(self, folder: Path, config: pytest.Config) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._config = config
        self._begun_s = time.monotonic()
        self._before_s = processor_s()
        self._files: dict[str, dict[str, float]] = defaultdict(lambda: dict.fromkeys(FIGURES, 0.0))
        self._tests_s: dict[str, float] = defaultdict(float)
        os.environ[WORKER] = str(os.getpid())

    @property
    def last(self) -> Path:
        """The folder of the last run's record, if there was one."""
        return self._folder.parent / LAST

    def begin(self) -> None:
        """What was before is not counted: this process was forked."""
        self._before_s = processor_s()
        os.environ[WORKER] = str(os.getpid())

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        took_s = (recorded(self.last) or kept()).wall_s
        items.sort(key=lambda item: -took_s.get(file_of(item.nodeid), 0.0))  # of a file, and of equals, the order stays

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """For `tests/run_memory.py`, which looks from outside."""
        (self._folder / f"{RUNNING}{os.getpid()}").write_text(nodeid)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        before_s, self._before_s = self._before_s, processor_s()
        report.__dict__["figures"] = {"processor_s": self._before_s - before_s, "memory_mb": memory_mb()}
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        figures: dict[str, float] = report.__dict__.get("figures", {"processor_s": 0.0, "memory_mb": 0.0})
        file = self._files[file_of(report.nodeid)]
        self._tests_s[report.nodeid] += report.duration
        file["tests"] += report.when == "call"
        file["wall_s"] += report.duration
        file["processor_s"] += figures["processor_s"]
        file["memory_mb"] = max(file["memory_mb"], figures["memory_mb"])

    def pytest_sessionfinish(self) -> None:
        written = {
            "arguments": list(self._config.invocation_params.args),
            "wall_s": time.monotonic() - self._begun_s,
            "files": self._files,
            "tests_s": {test: round(took_s, 3) for test, took_s in self._tests_s.items()},
        }
        (self._folder / f"pytest-{os.getpid()}.json").write_text(json.dumps(written))


def pytest_configure(config: pytest.Config) -> None:
    if folder := os.environ.get(FOLDER):
        config.pluginmanager.register(Record(Path(folder), config), "record of the run")
