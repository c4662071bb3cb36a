"""Which file of tests a worker may begin, so that the memory of all tests that run stays within a budget.

Some files start a whole robot, or two, as processes; others compute in the worker alone. A file waits, and a worker
takes a later one meanwhile, as long as there is no room for it. What a test needs is known from the last run, or from
one whose figures are kept (`tests/run_known.py`); what its markers tell counts for files that are new.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import pytest
from run_known import LARGE_MB, Known, file_of, kept, recorded
from run_memory import LEAST_MB

BUDGET_MB = 1000.0
"""For what the tests that run at a time need. Pytest and its workers share 130 MB more."""
GUESSED_MB = (({"zenoh", "sim", "process"}, 500.0), ({"sim"}, 230.0), ({"zenoh", "process"}, 120.0), ({"zenoh"}, 80.0))
"""Markers of tests of unknown files, and what those need that have all of them. The first: the processes of a robot."""
URGENT = ("alone", "beside")
"""Kinds of tests (`tests/run_spread.py`) by which the whole run gets longer when they wait."""


class Job(NamedTuple):
    """Tests of one file, which a worker runs in one go."""

    items: list[pytest.Item]
    need_mb: float


def jobs_of(items: Iterable[pytest.Item], folder: Path | None, usual: Known | None = None) -> list[Job]:
    """The tests by file and by what they need, those first that take longest; else in their order.

    `folder`: the record, if there is one; `usual`: what is known of the files that it lacks, None for what is kept.

    Tests that need much are a job of their own, so that the rest of their file fits beside more. Not so where they
    share a fixture of their file: what it has started runs during all of them, and each job would start it again.
    """
    record, usual = recorded(folder), usual or kept()
    if record is not None and not record.own_mb:
        record = None  # it was not watched
    found: dict[tuple[Path, bool], list[pytest.Item]] = defaultdict(list)
    needs_mb: dict[tuple[Path, bool], float] = defaultdict(float)
    items = list(items)
    whole = {item.path for item in items if _shares(item)}
    for item in items:
        need_mb = _need_mb(item, record, usual)
        part = item.path, need_mb > LARGE_MB and item.path not in whole
        found[part].append(item)
        needs_mb[part] = max(needs_mb[part], need_mb)
    jobs = [Job(of_part, needs_mb[part]) for part, of_part in found.items()]
    return sorted(jobs, key=lambda job: -_takes_s(job, record, usual))


def _takes_s(job: Job, record: Known | None, usual: Known) -> float:
    tests = [item.nodeid for item in job.items]
    known = record if record is not None and file_of(tests[0]) in record.files else usual
    return known.takes_s(tests)


def _need_mb(item: pytest.Item, record: Known | None, usual: Known) -> float:
    file, marks = file_of(item.nodeid), {mark.name for mark in item.iter_markers()}
    guesses: Iterable[tuple[set[str], float]] = GUESSED_MB
    if record is not None and file in record.files:
        if (need_mb := record.need_mb(item.nodeid)) is not None:
            return max(need_mb, LEAST_MB)
        guesses = GUESSED_MB[:1]  # what the looks have missed took a moment, as no robot does
    elif (need_mb := usual.need_mb(item.nodeid)) is not None:
        return need_mb if marks & {"zenoh", "sim", "process"} else LEAST_MB
    return next((mb for needed, mb in guesses if needed <= marks), LEAST_MB)


def _shares(item: pytest.Item) -> bool:
    """Whether a fixture of the test is made once for its file."""
    fixtures = item._fixtureinfo.name2fixturedefs  # type: ignore[attr-defined]
    return any(of_name[-1].scope == "module" for of_name in fixtures.values())


@dataclass
class Room:
    """The jobs of each kind that wait, as (number, memory in MB), and what those that run need."""

    waiting: dict[str, list[tuple[int, float]]]
    budget_mb: float = BUDGET_MB
    runs: dict[int, tuple[str, float]] = field(default_factory=dict)
    """By worker: the kind, and the need of its job."""

    def next_for(self, idle: Iterable[tuple[int, str]]) -> tuple[int, int] | None:
        """The next of the idle workers (each with its kind) that gets a job, and the job's number.

        Urgent kinds come first, and others leave them the room for what they begin next.
        """
        idle = list(idle)
        free_mb = self.budget_mb - sum(mb for _, mb in self.runs.values())
        kept_mb = self._kept_mb({kind for _, kind in idle})
        for worker, kind in sorted(idle, key=lambda one: one[1] not in URGENT):
            jobs, most_mb = self.waiting[kind], free_mb - (0.0 if kind in URGENT else kept_mb)
            job = next((job for job in jobs if job[1] <= most_mb), None)
            if job is None and jobs and not self.runs:
                job = jobs[0]  # which is over the budget by itself
            if job is not None:
                jobs.remove(job)
                self.runs[worker] = kind, job[1]
                return worker, job[0]
        return None

    def _kept_mb(self, idle_kinds: set[str]) -> float:
        """Room for the next urgent job: it begins when the smallest of those that run ends, or now."""
        runs = {kind: [mb for of, mb in self.runs.values() if of == kind] for kind in URGENT}
        for kind in URGENT:
            if runs[kind] or kind in idle_kinds:
                ends_mb = 0.0 if kind in idle_kinds else min(runs[kind])
                rest_mb = sum(map(sum, runs.values())) - ends_mb
                return next(
                    (max(mb - ends_mb, 0.0) for _, mb in self.waiting[kind] if rest_mb + mb <= self.budget_mb), 0.0
                )
        return 0.0

    def ended(self, worker: int) -> None:
        self.runs.pop(worker, None)
