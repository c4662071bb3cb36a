"""`cocoro experiment`: runs the paper's experiments, shows their progress, and reports them."""

from __future__ import annotations

import os
import sys
from contextlib import closing
from pathlib import Path
from typing import Annotated, TextIO

import msgspec
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from apps.cli import exits
from apps.cli.options import DescriptionOption, FramesOption, MeasuredOption, frames_of
from apps.cli.terminal import table
from apps.experiments.experiments import EXPERIMENTS, run
from apps.experiments.plan import ExperimentSettings
from apps.experiments.runs import RunResult
from cocoro.errors import ConfigError

EVERY = "all"


class RunProgress:
    """Shows a bar, the runs in work and the time left on a terminal; elsewhere prints a line for each finished run."""

    def __init__(self, out: TextIO) -> None:
        console = Console(file=out)
        self._out = out
        self._bar = Progress(
            BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}", markup=False),
            console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("")
        self._total = self._done = self._failed = 0
        self._running: list[str] = []

    def begin(self, total: int, had: int) -> None:
        self._total, self._done = total, had
        kept = f"; {had} of them have a result already" if had else ""
        self._print(f"{total} runs{kept}")
        self._bar.start()
        self._bar.update(self._task, total=total, completed=had)

    def started(self, name: str) -> None:
        self._running.append(name)
        self._bar.update(self._task, description=self.text())

    def ended(self, name: str, result: RunResult) -> None:
        if name in self._running:
            self._running.remove(name)
        self._done += 1
        error = result.get("error")
        self._failed += error is not None
        if error is not None or self._bar.disable:
            self._print(f"{self._done} of {self._total} {name}: {error or result.get('outcome', 'done')}")
        self._bar.update(self._task, completed=self._done, description=self.text())

    def close(self) -> None:
        """Leaves the terminal as it was."""
        self._bar.stop()

    def text(self) -> str:
        """The runs in work, and how many failed."""
        failed = f"{self._failed} failed; " if self._failed else ""
        return f"{failed}{', '.join(self._running)}"

    def _print(self, text: str) -> None:
        if self._bar.disable:
            print(text, file=self._out, flush=True)
        else:
            self._bar.print(text, markup=False, highlight=False, soft_wrap=True)


app = typer.Typer()


@app.command()
def experiment(
    which: Annotated[str, typer.Argument(metavar="E1|E2|E3|E4|E5|E6|all", help="Which of the paper's experiments.")],
    seeds: Annotated[
        int, typer.Option(min=1, max=1000, metavar="N", help="Number of seeds, from 0 on; each is another body.")
    ] = 10,
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", help="For report, plots, samples and models; runs with a result are not repeated."),
    ] = Path("experiments"),
    sensors: Annotated[str, typer.Option(metavar="ideal|real", help="Sensors without or with errors.")] = "real",
    body: Annotated[
        str, typer.Option(metavar="nominal|worn", help="A body that equals the nominal model, or differs from it.")
    ] = "worn",
    description: DescriptionOption = None,
    measured: MeasuredOption = None,
    frames: FramesOption = None,
    samples: Annotated[
        int,
        typer.Option(min=100, max=100_000, metavar="N", help="Arm samples of each body; a fifth of them is held out."),
    ] = 2600,
    jobs: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Runs at the same time; by default one per core.")
    ] = None,
    no_plots: Annotated[bool, typer.Option("--no-plots", help="Tables only, without matplotlib.")] = False,
) -> None:
    """Run the paper's experiments in virtual time and report them beside the paper's text and baselines.

    E1 hand-eye map, E2 reaching, E3 wheel distance, E4 navigation, E5 following, E6 fetching. Ctrl-C ends it; the same
    command continues.
    """
    sys.exit(
        run_experiments(which, seeds, out, sensors, body, (description, measured), frames, samples, jobs, not no_plots)
    )


def run_experiments(
    which: str, seeds: int, out: Path, sensors: str, body: str, robot_files: tuple[Path | None, Path | None],
    frames: str | None, samples: int, jobs: int | None, plots: bool,
) -> int:  # fmt: skip
    """Runs, writes the report, prints its tables; the exit code is 1 when a run failed.

    Raises ConfigError for an unknown experiment or an impossible option.
    """
    keys = list(EXPERIMENTS) if which == EVERY else [which.upper()]
    if keys[0] not in EXPERIMENTS:
        raise ConfigError(f"there is no experiment {which!r}; known are {', '.join(EXPERIMENTS)} and {EVERY}")
    for name, value, known in (("sensors", sensors, ("ideal", "real")), ("body", body, ("nominal", "worn"))):
        if value not in known:
            raise ConfigError(f"--{name} {value}: known are {' and '.join(known)}")
    description, measured = (None if file is None else str(file.resolve()) for file in robot_files)
    settings = ExperimentSettings(
        seeds=tuple(range(seeds)), out=out.resolve(), sensors="real" if sensors == "real" else "ideal",
        body="worn" if body == "worn" else "nominal", samples=samples, jobs=jobs or os.cpu_count() or 1,
        description=description, measured=measured,
    )  # fmt: skip
    settings.robot()  # refuses files that cannot be read before the first run
    if frames:
        settings = msgspec.structs.replace(settings, **frames_of(frames))
    progress = RunProgress(sys.stderr)
    try:
        with closing(progress):
            sections, path = run(keys, settings, progress, plots=plots)
    except KeyboardInterrupt:
        print("interrupted; finished runs are kept, and the same command continues", file=sys.stderr)
        return exits.REFUSED
    for section in sections:
        print(f"{section.key}: {section.title}")
        heads = ("measure", "who", "mean +- 95% CI", "worst", "unit", "wanted", "")
        rows = [(r.measure, r.who, r.mean, r.worst, r.unit, r.wanted, r.verdict) for r in section.rows]
        print(table(heads, rows))
        for note in (*section.notes, *section.errors):
            print(f"  {note}")
    print(f"{path} and {path.with_suffix('.html').name} are written")
    return exits.FAILED if any(section.errors for section in sections) else exits.DONE
