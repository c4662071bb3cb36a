"""Writes what each file of tests took: wall time, processor time (also of processes that it waited for), memory.

A pytest plugin. It does nothing unless `COCORO_SUITE_RECORD` names a folder; `deploy/test.sh` does that. Each run of
pytest writes one file there, which `bench/suite.py` reads.
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

FOLDER = "COCORO_SUITE_RECORD"
"""Environment variable: the folder to write to."""
FIGURES = ("tests", "wall_s", "processor_s", "memory_mb")


def processor_s() -> float:
    """Processor time of this process and of those of its children that have ended, s."""
    now = os.times()
    return now.user + now.system + now.children_user + now.children_system


def memory_mb() -> float:
    """Resident memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


class Record:
    """With pytest-xdist the workers measure, and the reports carry it to the process that writes."""

    def __init__(self, folder: Path, config: pytest.Config) -> None:
        self._folder = folder
        self._config = config
        self._begun_s = time.monotonic()
        self._before_s = processor_s()
        self._files: dict[str, dict[str, float]] = defaultdict(lambda: dict.fromkeys(FIGURES, 0.0))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        before_s, self._before_s = self._before_s, processor_s()
        report.__dict__["figures"] = {"processor_s": self._before_s - before_s, "memory_mb": memory_mb()}
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        figures: dict[str, float] = report.__dict__["figures"]
        file = self._files[report.nodeid.partition("::")[0]]
        file["tests"] += report.when == "call"
        file["wall_s"] += report.duration
        file["processor_s"] += figures["processor_s"]
        file["memory_mb"] = max(file["memory_mb"], figures["memory_mb"])

    def pytest_sessionfinish(self) -> None:
        if hasattr(self._config, "workerinput"):
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        written = {
            "arguments": list(self._config.invocation_params.args),
            "wall_s": time.monotonic() - self._begun_s,
            "files": self._files,
        }
        (self._folder / f"pytest-{os.getpid()}.json").write_text(json.dumps(written))


def pytest_configure(config: pytest.Config) -> None:
    if folder := os.environ.get(FOLDER):
        config.pluginmanager.register(Record(Path(folder), config), "suite record")
