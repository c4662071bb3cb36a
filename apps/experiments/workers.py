"""Worker processes of the experiments: each performs one run after the other and reports its progress.

They are connected by pipes alone. A pool of `concurrent.futures` has semaphores, which a command that is ended by a
signal leaves behind, and its workers finish their runs, for minutes, before they notice.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, NamedTuple, Self

from apps.experiments.carry_out import RunResult, carry_out
from apps.rehearsal.progress import RehearsalProgress

RUNS_A_PROCESS = 25
"""Runs after which a worker is replaced, against growing memory; starting one takes as long as a short run."""
REPORT_S = 0.5
"""Least time between two reports of a run."""
END_S = 5.0
"""Time that a worker has to end after it was told."""


class Report(NamedTuple):
    """A worker's report of its run: its progress, or its result."""

    run: str
    progress: RehearsalProgress | None = None
    result: RunResult | None = None


class _Worker:
    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_work, args=(theirs,), daemon=True)
        self.process.start()
        theirs.close()
        self.run: str | None = None
        self.left = RUNS_A_PROCESS

    def begin(self, run: str, kind: str, fields: dict[str, Any]) -> None:
        self.run = run
        self.left -= 1
        self.pipe.send((kind, fields))


class Workers:
    """A context of at most `count` worker processes. Leaving it ends them, whatever they are doing."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._workers: list[_Worker] = []

    def __enter__(self) -> Self:
        # One thread of linear algebra in each process, since there is a process for each core.
        os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join(END_S)

    @property
    def free(self) -> bool:
        """Whether another run can begin."""
        return sum(worker.run is not None for worker in self._workers) < self._count

    @property
    def busy(self) -> bool:
        return any(worker.run is not None for worker in self._workers)

    def begin(self, run: str, kind: str, fields: dict[str, Any]) -> None:
        """Begins a run in a worker that is free."""
        for worker in [worker for worker in self._workers if worker.run is None]:
            try:
                worker.begin(run, kind, fields)
                return
            except OSError:  # it was killed since its last run
                worker.process.join(END_S)
                self._workers.remove(worker)
        worker = _Worker()
        self._workers.append(worker)
        worker.begin(run, kind, fields)

    def reports(self, within_s: float) -> Iterator[Report]:
        """The reports that arrive within a time, from the first one on; none when none arrives."""
        of = {worker.pipe: worker for worker in self._workers if worker.run is not None}
        for pipe in wait(list(of), within_s):
            assert isinstance(pipe, Connection)
            worker = of[pipe]
            run = worker.run or ""
            try:
                report = pipe.recv()
            except (EOFError, OSError):
                worker.process.join(END_S)
                self._workers.remove(worker)
                yield Report(run, result={"error": f"its process ended: {_end_of(worker.process)}"})
                continue
            if isinstance(report, RehearsalProgress):
                yield Report(run, progress=report)
                continue
            worker.run = None
            if not worker.left:
                worker.pipe.close()
                worker.process.join(END_S)
                self._workers.remove(worker)
            yield Report(run, result=report)


def _end_of(process: BaseProcess) -> str:
    code = process.exitcode or 0
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


# --- in the worker --------------------------------------------------------------------------------


def _work(pipe: Connection) -> None:
    """Performs runs until the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the command ends its workers
    _quiet()
    _end_with(os.getppid())
    with pipe:
        while True:
            try:
                kind, fields = pipe.recv()
            except EOFError:
                return
            pipe.send(carry_out(kind, fields, _throttled(pipe.send)))


def _throttled(send: Callable[[RehearsalProgress], None]) -> Callable[[RehearsalProgress], None]:
    sent_s = time.monotonic()

    def tell(progress: RehearsalProgress) -> None:
        nonlocal sent_s
        if time.monotonic() - sent_s >= REPORT_S:
            sent_s = time.monotonic()
            send(progress)

    return tell


def _quiet() -> None:
    """Discards what a worker prints, because the display has the terminal."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)


def _end_with(parent: int) -> None:
    """Ends this process soon after its parent, which may be killed without a word."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(END_S / 5)
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()
