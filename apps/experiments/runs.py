"""Performs the runs of experiments in worker processes, and keeps each result on disk, so that a repeated command
continues where an earlier one was interrupted."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import msgspec

from apps.experiments.carry_out import RunResult
from apps.experiments.results import Section
from apps.experiments.workers import Workers
from apps.rehearsal.progress import RehearsalProgress
from cocoro.errors import naming

REFRESH_S = 1.0
"""Longest time between two ticks of the display."""


@dataclass(frozen=True)
class ExperimentRun:
    """One piece of work for a worker process. Runs of equal names are equal."""

    name: str
    """Name of its result's file in the folder `runs`."""
    kind: Literal["rehearse", "learn", "learn-rigid", "learn-wheels", "bend"]
    fields: dict[str, Any] = field(hash=False)
    """Rehearse: the request's fields; otherwise the arguments of the lesson of that name."""
    needs: tuple[str, ...] = ()
    """Names of the runs whose results it uses."""


class RunDisplay(Protocol):
    """Shows the progress of `perform`."""

    def begin(self, waiting: Sequence[str], had: int) -> None:
        """The runs that are to be performed; `had` others have a result from an earlier time."""

    def started(self, name: str) -> None: ...

    def advanced(self, name: str, progress: RehearsalProgress) -> None: ...

    def ended(self, name: str, result: RunResult) -> None: ...

    def reported(self, section: Section) -> None:
        """All runs of an experiment have ended."""

    def tick(self) -> None:
        """Time has passed."""


def perform(
    runs: Iterable[ExperimentRun], folder: Path, jobs: int, display: RunDisplay,
    ended: Callable[[dict[str, RunResult]], None] = lambda _: None,
) -> dict[str, RunResult]:  # fmt: skip
    """Performs all runs in `jobs` worker processes and returns their results by name. `ended` gets the results so far.

    A run starts when the runs that it needs have finished, and fails when one of them failed. A result in `folder` is
    used again when the run's fields and the results that it used are the same.
    """
    of = {run.name: run for run in runs}
    results: dict[str, RunResult] = {}
    waiting: dict[str, ExperimentRun] = {}
    for run in of.values():
        stored = _stored(run, folder, results) if all(name in results for name in run.needs) else None
        if stored is not None:
            results[run.name] = stored
        else:
            waiting[run.name] = run
    for run in waiting.values():
        lacking = [name for name in run.needs if name not in waiting and name not in results]
        assert not lacking, f"{run.name} needs {lacking}, which are not among the runs"
    display.begin(list(waiting), len(results))
    with Workers(jobs) as workers:
        while waiting or workers.busy:
            _start(waiting, results, workers, display)
            for report in workers.reports(REFRESH_S):
                if report.result is None:
                    assert report.progress is not None
                    display.advanced(report.run, report.progress)
                    continue
                results[report.run] = report.result
                _store(of[report.run], folder, results)
                display.ended(report.run, report.result)
                ended(results)
            display.tick()
    ended(results)
    return results


def _start(
    waiting: dict[str, ExperimentRun], results: dict[str, RunResult], workers: Workers, display: RunDisplay
) -> None:
    for run in list(waiting.values()):
        failed = next((name for name in run.needs if "error" in results.get(name, {})), None)
        if failed is not None:
            del waiting[run.name]
            results[run.name] = {"error": f"{failed} failed: {results[failed]['error']}"}
            display.ended(run.name, results[run.name])
        elif workers.free and all(name in results for name in run.needs):
            del waiting[run.name]
            display.started(run.name)
            workers.begin(run.name, run.kind, run.fields)


def _path(run: ExperimentRun, folder: Path) -> Path:
    return folder / f"{run.name}.json"


def _stored(run: ExperimentRun, folder: Path, results: Mapping[str, RunResult]) -> RunResult | None:
    """The stored result of an equal run that used equal results; None when there is none."""
    try:
        data = json.loads(_path(run, folder).read_text())
        same = data["fields"] == _as_json(run.fields) and data["after"] == _used(run, results)
        return dict(data["result"]) if same else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _store(run: ExperimentRun, folder: Path, results: Mapping[str, RunResult]) -> None:
    result = results[run.name]
    if "error" in result:
        return
    path = _path(run, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    data = {"kind": run.kind, "fields": _as_json(run.fields), "after": _used(run, results), "result": result}
    with naming(part):
        part.write_text(json.dumps(data))
    part.replace(path)


def _used(run: ExperimentRun, results: Mapping[str, RunResult]) -> dict[str, str]:
    """Fingerprints of the results that the run used."""
    return {
        name: hashlib.sha256(json.dumps(results[name], sort_keys=True).encode()).hexdigest()[:16] for name in run.needs
    }


def _as_json(fields: dict[str, Any]) -> Any:
    return json.loads(msgspec.json.encode(fields))
