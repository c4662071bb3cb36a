"""The experiments by name, and the function that runs and reports them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from apps.experiments import (
    e1_hand_eye_map,
    e2_reaching,
    e3_wheel_distance,
    e4_navigation,
    e5_following,
    e6_fetching,
    figures,
    report,
)
from apps.experiments.carry_out import RunResult
from apps.experiments.plan import ExperimentSettings
from apps.experiments.results import Section
from apps.experiments.runs import ExperimentRun, RunDisplay, perform


class Experiment(Protocol):
    """A module of an experiment: the runs that it needs, and its section of the report from their results."""

    KEY: str
    TITLE: str

    def runs(self, settings: ExperimentSettings) -> list[ExperimentRun]: ...

    def section(self, settings: ExperimentSettings, results: dict[str, RunResult]) -> Section: ...


MODULES = (e1_hand_eye_map, e2_reaching, e3_wheel_distance, e4_navigation, e5_following, e6_fetching)
EXPERIMENTS: dict[str, Experiment] = {module.KEY: module for module in MODULES}


def run(
    keys: Sequence[str], settings: ExperimentSettings, display: RunDisplay, *, plots: bool
) -> tuple[list[Section], Path]:
    """Runs experiments and writes the report; returns its sections and the path of its Markdown file.

    Each section is displayed as soon as its runs have ended. Finished runs are kept when it is interrupted. Raises
    ConfigError when `plots` needs a missing library.
    """
    if plots:
        figures.available()
    runs: dict[str, ExperimentRun] = {}
    for key in keys:
        runs |= {run.name: run for run in EXPERIMENTS[key].runs(settings)}
    sections: dict[str, Section] = {}

    def ended(results: dict[str, RunResult]) -> None:
        for key in keys:
            needed = EXPERIMENTS[key].runs(settings)
            if key in sections or any(run.name not in results for run in needed):
                continue
            sections[key] = section = EXPERIMENTS[key].section(settings, results)
            section.errors = [
                f"{run.name}: {results[run.name]['error']}" for run in needed if "error" in results[run.name]
            ]
            display.reported(section)

    perform(runs.values(), settings.out / "runs", settings.jobs, display, ended)
    found = [sections[key] for key in keys]
    return found, report.write(found, settings, plots=plots)
