"""Performs the runs of experiments in worker processes, and keeps each result on disk, so that a repeated command
continues where an earlier one was interrupted."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import msgspec

from apps.experiments import lessons
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.errors import CocoroError, naming

TASKS_A_PROCESS = 25
"""Runs after which a worker process is replaced, against growing memory; starting one takes as long as a short run."""
LESSONS: dict[str, Callable[..., dict[str, Any]]] = {"learn": lessons.learn, "bend": lessons.bend}
RunResult = dict[str, Any]
"""A run's result as JSON data; a failed run has its message under 'error'."""


@dataclass(frozen=True)
class ExperimentRun:
    """One piece of work for a worker process. Runs of equal names are equal."""

    name: str
    """Name of its result's file in the folder `runs`."""
    kind: Literal["rehearse", "learn", "bend"]
    fields: dict[str, Any] = field(hash=False)
    """Rehearse: the request's fields; otherwise the arguments of the lesson of that name."""
    needs: tuple[str, ...] = ()
    """Names of the runs whose results it uses."""


class RunDisplay(Protocol):
    """Shows the progress of `perform`."""

    def begin(self, total: int, had: int) -> None:
        """`had` of the `total` runs have a result from an earlier time."""

    def started(self, name: str) -> None: ...

    def ended(self, name: str, result: RunResult) -> None: ...


def carry_out(kind: str, fields: dict[str, Any]) -> RunResult:
    """Performs one run in a worker process; errors become part of the result."""
    try:
        if kind == "rehearse":
            request = msgspec.convert(fields, RehearsalRequest)
            if request.samples is not None and request.bend_s is not None:
                # Samples of an interrupted run do not contain the bend at that time.
                Path(request.samples).unlink(missing_ok=True)
            return dict(rehearse(request))
        return dict(LESSONS[kind](**fields))
    except (CocoroError, msgspec.ValidationError) as error:
        return {"error": str(error)}
    except Exception as error:  # a failed run must not end hundreds of others
        return {"error": f"{type(error).__name__}: {error}"}


def perform(runs: Iterable[ExperimentRun], folder: Path, jobs: int, display: RunDisplay) -> dict[str, RunResult]:
    """Performs all runs in `jobs` worker processes and returns their results by name.

    A run starts when the runs that it needs have finished, and fails when one of them failed. A result in `folder` is
    used again when the run's fields and the results that it used are the same.
    """
    results: dict[str, RunResult] = {}
    waiting: dict[str, ExperimentRun] = {}
    for run in runs:
        stored = _stored(run, folder, results) if all(name in results for name in run.needs) else None
        if stored is not None:
            results[run.name] = stored
        else:
            waiting[run.name] = run
    for run in waiting.values():
        lacking = [name for name in run.needs if name not in waiting and name not in results]
        assert not lacking, f"{run.name} needs {lacking}, which are not among the runs"
    display.begin(len(waiting) + len(results), len(results))
    # One thread of linear algebra in each process, since there is a process for each core.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, initializer=_quiet, max_tasks_per_child=TASKS_A_PROCESS) as pool:
        running: dict[Future[RunResult], ExperimentRun] = {}
        try:
            while waiting or running:
                _start(waiting, running, results, jobs, pool.submit, display)
                done, _ = wait(running, return_when=FIRST_COMPLETED) if running else (set(), set())
                for future in done:
                    run = running.pop(future)
                    results[run.name] = result = future.result()
                    _store(run, folder, results)
                    display.ended(run.name, result)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return results


def _start(
    waiting: dict[str, ExperimentRun],
    running: dict[Future[RunResult], ExperimentRun],
    results: dict[str, RunResult],
    jobs: int,
    submit: Callable[..., Future[RunResult]],
    display: RunDisplay,
) -> None:
    for run in list(waiting.values()):
        failed = next((name for name in run.needs if "error" in results.get(name, {})), None)
        if failed is not None:
            del waiting[run.name]
            results[run.name] = {"error": f"{failed} failed: {results[failed]['error']}"}
            display.ended(run.name, results[run.name])
        elif len(running) < jobs and all(name in results for name in run.needs):
            del waiting[run.name]
            display.started(run.name)
            running[submit(carry_out, run.kind, run.fields)] = run


def _quiet() -> None:
    """Discards what a worker prints, because the display has the terminal."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)


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
