"""Shows what `cocoro experiment` does: the runs in work, how far each is, the time left, and results as they come."""

from __future__ import annotations

import re
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column

from apps.cli.terminal import print_table
from apps.experiments.carry_out import RunResult
from apps.experiments.results import Section
from apps.rehearsal.progress import RehearsalProgress

EVERY_S = 15.0
"""Time between two lines of progress where there is no terminal."""
LEAST_SHARE = 0.02
"""Done part of a run from which on it tells how long the whole takes."""
Clock = Callable[[], float]


class TimeLeft:
    """Estimates the time that the runs still take: by those of their kind that have ended, or are well under way."""

    def __init__(self, waiting: Sequence[str], jobs: int, clock: Clock) -> None:
        self._waiting = list(waiting)
        self._jobs = jobs
        self._clock = clock
        self._begun_s: dict[str, float] = {}
        self._share: dict[str, float] = {}
        self._took_s: dict[str, list[float]] = defaultdict(list)

    def started(self, name: str) -> None:
        self._begun_s[name] = self._clock()

    def advanced(self, name: str, share: float | None) -> None:
        if share is not None:
            self._share[name] = share

    def ended(self, name: str) -> None:
        if name in self._waiting:
            self._waiting.remove(name)
        if name in self._begun_s:
            self._took_s[_kind(name)].append(self._clock() - self._begun_s.pop(name))

    def __str__(self) -> str:
        """`about 4 min left`; `at least ...` while runs are left of whose kind none is known; '' when none is."""
        expected = {name: self._expected_s(_kind(name)) for name in self._waiting}
        left = {
            name: max(whole_s - (self._clock() - self._begun_s.get(name, self._clock())), 1.0)
            for name, whole_s in expected.items()
            if whole_s is not None
        }
        if not left:
            return ""
        seconds = max(sum(left.values()) / self._jobs, *left.values())
        text = f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
        return f"{'about' if len(left) == len(expected) else 'at least'} {text} left"

    def _expected_s(self, kind: str) -> float | None:
        took = self._took_s.get(kind) or [
            (self._clock() - begun_s) / self._share[name]
            for name, begun_s in self._begun_s.items()
            if _kind(name) == kind and self._share.get(name, 0.0) >= LEAST_SHARE
        ]
        return sum(took) / len(took) if took else None


def _kind(name: str) -> str:
    """The name of a run without its seed: `babble-arm` of `babble-arm-3`."""
    return re.sub(r"(-\d+)+$", "", name)


class RunProgress:
    """Shows a bar, the runs in work and the time left on a terminal; elsewhere prints lines. Tables of experiments that
    have ended go to standard output."""

    def __init__(self, out: TextIO, jobs: int = 1, clock: Clock = time.monotonic) -> None:
        console = Console(file=out)
        cut = Column(no_wrap=True, overflow="ellipsis")
        text = TextColumn("{task.description}", markup=False, table_column=cut)
        self._out = out
        self._jobs = jobs
        self._clock = clock
        self._bar = Progress(
            BarColumn(bar_width=20), MofNCompleteColumn(), text,
            console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("")
        self._total = self._done = self._failed = 0
        self._running: dict[str, RehearsalProgress | None] = {}
        self._begun_s = self._said_s = clock()
        self._started_s: dict[str, float] = {}
        self._left = TimeLeft((), jobs, clock)

    def begin(self, waiting: Sequence[str], had: int) -> None:
        self._total, self._done = len(waiting) + had, had
        self._left = TimeLeft(waiting, self._jobs, self._clock)
        kept = f"; {had} of them have a result already" if had else ""
        self._print(f"{self._total} runs{kept}")
        self._bar.start()
        self._bar.update(self._task, total=self._total, completed=had)

    def started(self, name: str) -> None:
        self._running[name] = None
        self._started_s[name] = self._clock()
        self._left.started(name)
        if self._bar.disable:
            self._print(f"{name} begins")
        self._renew()

    def advanced(self, name: str, progress: RehearsalProgress) -> None:
        self._running[name] = progress
        self._left.advanced(name, progress.share)

    def ended(self, name: str, result: RunResult) -> None:
        self._running.pop(name, None)
        self._left.ended(name)
        self._done += 1
        error = result.get("error")
        self._failed += error is not None
        began_s = self._started_s.pop(name, None)
        took = "" if began_s is None else f" ({self._clock() - began_s:.0f} s)"
        self._print(f"{self._done} of {self._total} {name}{took}: {error or described(result)}")
        self._bar.update(self._task, completed=self._done)
        self._renew()

    def reported(self, section: Section) -> None:
        """Prints the table of an experiment."""
        self._bar.stop()
        print(f"{section.key}: {section.title}")
        heads = ("measure", "who", "mean +- 95% CI", "worst", "unit", "wanted", "")
        print_table(heads, [(r.measure, r.who, r.mean, r.worst, r.unit, r.wanted, r.verdict) for r in section.rows])
        for note in (*section.notes, *section.errors):
            print(f"  {note}")
        sys.stdout.flush()
        if self._done < self._total:
            self._bar.start()

    def tick(self) -> None:
        self._renew()
        now_s = self._clock()
        if self._bar.disable and self._running and now_s - self._said_s >= EVERY_S:
            self._print(f"{now_s - self._begun_s:.0f} s, {self._done} of {self._total} done: {self.text()}")

    def close(self) -> None:
        """Leaves the terminal as it was."""
        self._bar.stop()

    def text(self) -> str:
        """The time left, how many runs failed, and the runs in work."""
        runs = (name if progress is None else f"{name} {progress}" for name, progress in self._running.items())
        failed = (f"{self._failed} failed",) if self._failed else ()
        return "; ".join(part for part in (str(self._left), *failed, ", ".join(runs)) if part)

    def _renew(self) -> None:
        self._bar.update(self._task, description=self.text())

    def _print(self, text: str) -> None:
        self._said_s = self._clock()
        if self._bar.disable:
            print(text, file=self._out, flush=True)
        else:
            self._bar.print(text, markup=False, highlight=False, soft_wrap=True)


def described(result: RunResult) -> str:
    """A run's result in a line: its outcome, and what was learned."""
    parts = [part for part in (result.get("outcome"), result.get("reason"), result.get("said")) if part]
    if "arm" in result:
        best = min(result["arm"]["scores"], key=lambda score: score["held_out_m"])
        parts.append(f"{best['name']} predicts the hand to {1000 * best['held_out_m']:.1f} mm")
    if "wheels" in result:
        parts.append(f"wheel distance {1000 * result['wheels']['separation_m']:.1f} mm")
    if "sim_s" in result:
        parts.append(f"{result['sim_s']:.0f} simulated s")
    return ", ".join(parts) or "done"
