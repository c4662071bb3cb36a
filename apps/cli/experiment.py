"""`cocoro experiment`: the paper's experiments, run and shown while they run."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import TextIO

import msgspec

from apps.cli import exits
from apps.cli.options import frames_of
from apps.cli.table import table
from apps.experiments.every import EXPERIMENTS, run
from apps.experiments.runs import RunResult
from apps.experiments.settings import ExperimentSettings
from cocoro.errors import ConfigError

EVERY = "all"


class RunProgress:
    """A bar and what runs now, on one line of a terminal; a line for each run that ended elsewhere."""

    BAR = 24

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._live = out.isatty()
        self._total = self._had = self._done = self._failed = 0
        self._running: list[str] = []
        self._begun_s = time.monotonic()

    def begin(self, total: int, had: int) -> None:
        self._total, self._had, self._done = total, had, had
        kept = f"; {had} of them are there already" if had else ""
        self._say(f"{total} runs{kept}")

    def started(self, name: str) -> None:
        self._running.append(name)
        if self._live:
            self._show()

    def ended(self, name: str, result: RunResult) -> None:
        if name in self._running:
            self._running.remove(name)
        self._done += 1
        error = result.get("error")
        self._failed += error is not None
        if error is not None or not self._live:
            self._say(f"{self._done} of {self._total} {name}: {error or result.get('outcome', 'done')}")
        if self._live:
            self._show()

    def end(self) -> None:
        if self._live:
            self._out.write("\r\x1b[K")
            self._out.flush()

    def text(self) -> str:
        full = round(self.BAR * self._done / max(self._total, 1))
        new = self._done - self._had
        spent_s = time.monotonic() - self._begun_s
        left = f", {_time(spent_s * (self._total - self._done) / new)} left" if new else ""
        failed = f", {self._failed} could not be" if self._failed else ""
        now = f": {', '.join(self._running)}" if self._running else ""
        return f"[{'#' * full}{'.' * (self.BAR - full)}] {self._done} of {self._total}{failed}{left}{now}"

    def _show(self) -> None:
        width = os.get_terminal_size(self._out.fileno()).columns - 1
        self._out.write(f"\r\x1b[K{self.text()[:width]}")
        self._out.flush()

    def _say(self, text: str) -> None:
        self._out.write(("\r\x1b[K" if self._live else "") + text + "\n")
        self._out.flush()


def experiment(
    which: str, seeds: int, out: Path, sensors: str, body: str, frames: str | None, samples: int, jobs: int | None,
    plots: bool,
) -> int:  # fmt: skip
    """Run, write the report, print its tables. The exit code is 1 where a run could not be. Raises ConfigError."""
    keys = list(EXPERIMENTS) if which == EVERY else [which.upper()]
    if keys[0] not in EXPERIMENTS:
        raise ConfigError(f"there is no experiment {which!r}; known are {', '.join(EXPERIMENTS)} and {EVERY}")
    for name, value, known in (("sensors", sensors, ("ideal", "real")), ("body", body, ("nominal", "worn"))):
        if value not in known:
            raise ConfigError(f"--{name} {value}: it is {' or '.join(known)}")
    settings = ExperimentSettings(
        seeds=tuple(range(seeds)), out=out.resolve(), sensors="real" if sensors == "real" else "ideal",
        body="worn" if body == "worn" else "nominal", samples=samples, jobs=jobs or os.cpu_count() or 1,
    )  # fmt: skip
    if frames:
        settings = msgspec.structs.replace(settings, **frames_of(frames))
    progress = RunProgress(sys.stderr)
    try:
        sections, path = run(keys, settings, progress, plots=plots)
    except KeyboardInterrupt:
        progress.end()
        print("ended; what was run is kept, and the same command goes on with it", file=sys.stderr)
        return exits.REFUSED
    progress.end()
    for section in sections:
        print(f"{section.key}: {section.title}")
        heads = ("measure", "who", "mean +- 95% CI", "worst", "unit", "wanted", "")
        rows = [(r.measure, r.who, r.mean, r.worst, r.unit, r.wanted, r.verdict) for r in section.rows]
        print(table(heads, rows))
        for note in (*section.notes, *section.errors):
            print(f"  {note}")
    print(f"{path} and {path.with_suffix('.html').name} are written")
    return exits.FAILED if any(section.errors for section in sections) else exits.DONE


def _time(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"
