"""`cocoro experiment`: runs the paper's experiments, shows their progress, and reports them."""

from __future__ import annotations

import os
import sys
from contextlib import closing
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from apps.cli import completions, exits
from apps.cli.experiment_progress import RunProgress
from apps.cli.options import AnyRobotOption, FramesOption, JsonOption, MeasuredOption, frames_of
from apps.cli.output import tell
from apps.experiments.experiments import EXPERIMENTS, run
from apps.experiments.plan import ExperimentSettings
from cocoro.errors import ConfigError, choice_of
from cocoro.robot_files import RobotFiles
from deploy.which_robot import files_of
from services.executive.tasks import BabbleArmTask, BabbleWheelsTask

EVERY = "all"


app = typer.Typer()


@app.command()
def experiment(
    which: Annotated[
        str,
        typer.Argument(
            metavar="E1|E2|E3|E4|E5|E6|all",
            autocompletion=completions.of(*EXPERIMENTS, "all"),
            help="Which of the paper's experiments.",
        ),
    ],
    seeds: Annotated[
        int, typer.Option(min=1, max=1000, metavar="N", help="Number of seeds, from 0 on; each is another body.")
    ] = 10,
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", help="For report, plots, samples and models; runs with a result are not repeated."),
    ] = Path("out/experiments"),
    sensors: Annotated[str, typer.Option(metavar="ideal|real", help="Sensors without or with errors.")] = "real",
    body: Annotated[
        str, typer.Option(metavar="nominal|worn", help="A body that equals the nominal model, or differs from it.")
    ] = "worn",
    robot: AnyRobotOption = None,
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
    json: JsonOption = False,
) -> None:
    """Run the paper's experiments in virtual time and report them beside its text and baselines.

    E1 hand-eye map, E2 reaching, E3 wheel distance, E4 navigation, E5 following, E6 fetching. Ctrl-C ends it; the same
    command continues.
    """
    sys.exit(
        run_experiments(
            which,
            seeds,
            out,
            sensors,
            body,
            files_of(robot).with_measured(measured),
            frames,
            samples,
            jobs,
            not no_plots,
            json,
        )
    )


def run_experiments(
    which: str, seeds: int, out: Path, sensors: str, body: str, files: RobotFiles,
    frames: str | None, samples: int, jobs: int | None, plots: bool, as_json: bool = False,
) -> int:  # fmt: skip
    """Runs, writes the report, prints its tables; the exit code is 1 when a run failed.

    Raises ConfigError for an unknown experiment or an impossible option.
    """
    keys = list(EXPERIMENTS) if which == EVERY else [which.upper()]
    if keys[0] not in EXPERIMENTS:
        raise ConfigError(f"there is no experiment {which!r}; {choice_of(which.upper(), [*EXPERIMENTS, EVERY])}")
    for name, value, known in (("sensors", sensors, ("ideal", "real")), ("body", body, ("nominal", "worn"))):
        if value not in known:
            raise ConfigError(f"--{name} {value}: {choice_of(value, known)}")
    measured = None if files.measured is None else str(files.measured.resolve())
    settings = ExperimentSettings(
        seeds=tuple(range(seeds)), out=out.resolve(), sensors="real" if sensors == "real" else "ideal",
        body="worn" if body == "worn" else "nominal", samples=samples, jobs=jobs or os.cpu_count() or 1,
        description=None if files.description is None else str(files.description), measured=measured,
    )  # fmt: skip
    if lack := settings.robot().lacks(
        (*BabbleArmTask.needs_body, *BabbleWheelsTask.needs_body)
    ):  # files that cannot be read are refused, too
        raise ConfigError(f"{lack}: every experiment begins with learning the body from the sight of its hand")
    if frames:
        settings = msgspec.structs.replace(settings, **frames_of(frames))
    progress = RunProgress(sys.stderr, settings.jobs)
    try:
        with closing(progress):
            sections, path = run(keys, settings, progress, plots=plots)
    except KeyboardInterrupt:
        print("interrupted; finished runs are kept, and the same command continues", file=sys.stderr)
        return exits.REFUSED
    data = {"report": str(path), "sections": [section.data() for section in sections]}
    tell(as_json, data, f"{path} and {path.with_suffix('.html').name} are written")
    return exits.FAILED if any(section.errors for section in sections) else exits.DONE
