"""The paper's experiments: what is run, what is kept, and what the report says of given results."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Sequence
from math import cos, isnan, sin
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil
import pytest
from learning_arm import sightings

from apps.cli import experiment as experimenting
from apps.cli.experiment_progress import RunProgress, TimeLeft
from apps.cli.main import main
from apps.experiments import lessons, plan, report, workers
from apps.experiments.carry_out import LESSONS, RunResult
from apps.experiments.experiments import EXPERIMENTS
from apps.experiments.plan import ExperimentSettings
from apps.experiments.results import Section, summarise
from apps.experiments.runs import ExperimentRun, perform
from apps.learning.dataset import HandRow, SampleFile, WheelRow, hand_header, wheel_header
from apps.learning.study import BEST
from apps.rehearsal.progress import RehearsalProgress
from apps.rehearsal.request import RehearsalRequest
from cocoro.learning.handmap import NominalModel
from cocoro.robot import Robot

HIDE_CURSOR, SHOW_CURSOR = "\x1b[?25l", "\x1b[?25h"

# --- statistics ---------------------------------------------------------------------------------------


def test_a_mean_has_a_confidence_interval_and_a_worst_that_depends_on_what_is_good() -> None:
    values = [1.0, 2.0, 3.0, float("nan")]
    low = summarise(values)
    assert (low.mean, low.worst, low.runs, low.median) == (2.0, 3.0, 3, 2.0)
    assert low.ci95 == pytest.approx(4.303 / 3**0.5, abs=1e-3)  # Student's t with 2 degrees of freedom
    assert summarise(values, best="high").worst == 1.0
    assert summarise([-3.0, 2.0], best="zero").worst == -3.0


def test_one_value_has_no_interval_and_none_has_no_mean() -> None:
    assert isnan(summarise([1.0]).ci95)
    assert isnan(summarise([]).mean)


# --- runs ---------------------------------------------------------------------------------------------


class Killed:
    """A worker that was killed while it had nothing to do."""

    def __init__(self) -> None:
        self.run: str | None = None
        self.process = self

    def begin(self, run: str, kind: str, fields: dict[str, Any]) -> None:
        raise BrokenPipeError

    def join(self, _timeout_s: float) -> None:
        pass


def test_a_run_begins_in_a_new_worker_where_an_idle_one_was_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[str] = []

    class Fresh(Killed):
        def begin(self, run: str, kind: str, fields: dict[str, Any]) -> None:
            begun.append(run)

    monkeypatch.setattr(workers, "_Worker", Fresh)
    pool = workers.Workers(1)
    pool._workers = [Killed()]  # type: ignore[list-item]
    pool.begin("reach", "rehearse", {})
    assert begun == ["reach"]
    assert len(pool._workers) == 1


class Quiet:
    def __init__(self) -> None:
        self.begun: list[str] = []

    def begin(self, waiting: Sequence[str], had: int) -> None: ...

    def advanced(self, name: str, progress: RehearsalProgress) -> None: ...

    def reported(self, section: Section) -> None: ...

    def tick(self) -> None: ...

    def started(self, name: str) -> None:
        self.begun.append(name)

    def ended(self, name: str, result: RunResult) -> None: ...


def test_every_experiment_asks_for_rehearsals_that_are_possible_and_names_what_it_needs(tmp_path: Path) -> None:
    settings = ExperimentSettings(seeds=(0, 1), out=tmp_path)
    for experiment in EXPERIMENTS.values():
        given: set[str] = set()
        for run in experiment.runs(settings):
            assert set(run.needs) <= given
            given.add(run.name)
            if run.kind == "rehearse":
                request = msgspec.convert(run.fields, RehearsalRequest)
                assert (request.sensors, request.body) == ("real", "worn")
            else:
                assert run.kind in LESSONS
            msgspec.json.encode(run.fields)


def test_every_run_of_an_experiment_is_of_the_robot_that_is_described(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text("[base]\nwheel_separation_m = 0.3\n")
    settings = ExperimentSettings(seeds=(0,), out=tmp_path, measured=str(own))
    assert settings.robot().base.wheel_separation_m == 0.3
    for experiment in EXPERIMENTS.values():
        for run in experiment.runs(settings):
            assert run.fields["measured"] == str(own)
            if run.kind == "rehearse":
                assert msgspec.convert(run.fields, RehearsalRequest).measured == str(own)


def test_what_cannot_be_run_fails_with_its_reason_and_so_does_what_needs_it(tmp_path: Path) -> None:
    runs = [
        ExperimentRun("one", "learn", {"arm": str(tmp_path / "a"), "wheels": "w", "into": str(tmp_path / "m.json")}),
        ExperimentRun("two", "rehearse", {"task": "fetch"}, needs=("one",)),
    ]
    display = Quiet()
    results = perform(runs, tmp_path / "runs", 1, display)
    assert "No such file" in results["one"]["error"]
    assert results["two"]["error"].startswith("one failed")
    assert display.begun == ["one"]
    assert not (tmp_path / "runs").exists()  # errors are not kept: the next time tries again


def test_an_interrupted_experiment_leaves_no_worker_behind(tmp_path: Path) -> None:
    class Interrupted(Quiet):
        def tick(self) -> None:
            raise KeyboardInterrupt

    runs = [ExperimentRun("one", "rehearse", {"task": {"task": "babble-arm"}})]
    with pytest.raises(KeyboardInterrupt):
        perform(runs, tmp_path / "runs", 1, Interrupted())
    assert not [child for child in psutil.Process().children() if "--multiprocessing-fork" in child.cmdline()]


def arm_and_wheels(settings: ExperimentSettings, robot: Robot) -> None:
    seen = sightings(robot, draws=60)
    header = hand_header(robot, NominalModel(robot).joints, robot.claw.level_roll_rad)
    with SampleFile(settings.arm_file(0), HandRow, robot, header) as writer:
        writer.append(
            HandRow(
                stamp_ns=number * 10**8, draw=int(draw), angles_rad=tuple(angles), head_rad=(0.0, 0.0),
                seen_m=tuple(place), area_px=300,
            )
            for number, (angles, place, draw) in enumerate(
                zip(seen.angles_rad.tolist(), seen.places_m.tolist(), seen.draws, strict=True)
            )
        )  # fmt: skip
    with SampleFile(settings.wheels_file(0), WheelRow, robot, wheel_header(robot, 0.06)) as writer:
        writer.append(
            WheelRow(
                stamp_ns=number, trial=number, left_mps=-0.1, right_mps=0.1, left_m=-0.03 * way, right_m=0.03 * way,
                before_m=(1.5, 0.0), after_m=(1.5 * cos(turn), -1.5 * sin(turn)), turned_rad=turn, height_m=0.06,
            )
            for number, way in enumerate((1, -1) * 3)
            if (turn := 0.06 * way / 0.255)
        )  # fmt: skip


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory, robot: Robot) -> tuple[ExperimentSettings, RunResult]:
    """A body that has learned, and what its lesson says."""
    settings = ExperimentSettings(seeds=(0,), out=tmp_path_factory.mktemp("experiments"))
    arm_and_wheels(settings, robot)
    run = plan.learned(settings, 0)[-1]
    return settings, lessons.learn(**run.fields, method=BEST.name)


def test_a_lesson_tells_how_good_the_map_is_and_what_the_wheels_are(
    learned: tuple[ExperimentSettings, RunResult],
) -> None:
    settings, result = learned
    assert settings.model_file(0).is_file()
    assert {score["name"] for score in result["arm"]["scores"]} >= {"the nominal model", result["arm"]["chosen"]}
    assert result["wheels"]["separation_m"] == pytest.approx(0.255, abs=1e-3)
    assert set(result["curves"]["default"]) == set(result["curves"]["paper"]) == set(result["curves"]["rigid"])
    json.dumps(result, allow_nan=False)


def test_a_kept_result_is_used_until_what_it_stands_on_changes(tmp_path: Path) -> None:
    kept = {"kind": "rehearse", "fields": {"task": "park"}, "after": {}, "result": {"outcome": "done"}}
    (tmp_path / "one.json").write_text(json.dumps(kept))
    (tmp_path / "two.json").write_text(json.dumps({**kept, "after": {"one": "something else"}}))
    one = ExperimentRun("one", "rehearse", {"task": "park"})
    two = ExperimentRun("two", "learn", {"arm": str(tmp_path / "none"), "wheels": "", "into": ""}, needs=("one",))
    display = Quiet()
    results = perform([one, two], tmp_path, 1, display)
    assert results["one"] == {"outcome": "done"}
    assert display.begun == ["two"]


# --- report -------------------------------------------------------------------------------------------

TRACE = {
    "time_s": [0.0, 0.1], "phase": ["touch", "follow"], "target": ["red_can", "green_can"],
    "body": [[0.0, 0.0, 0.0]] * 2,
    "hand_m": [[0.4, 0.0, 0.2], [0.5, 0.0, 0.2]], "felt_m": [None, [0.5, 0.0, 0.2]],
    "target_m": [[0.6, 0.0, 0.2]] * 2,
}  # fmt: skip
TOUCHED = {
    "label": "red_can", "outcome": "done", "reason": "", "sim_s": 2.0, "longest_stall_s": 0.1, "target_edge_m": 0.205,
    "hand_to_target": {"gap_m": 0.01, "rho_m": 0.01, "azimuth_rad": 0.0, "elevation_rad": 0.0},
}  # fmt: skip
FOLLOWED = {"mean_gap_m": 0.8, "max_gap_m": 1.1, "min_gap_m": 0.7, "lost_s": 0.1, "contacts": 0}
FETCHED = {"held": True, "knocked_over": []}


def made_up(run: ExperimentRun, lesson: RunResult) -> dict[str, Any]:
    """A plausible result of a run."""
    if run.kind in ("learn", "learn-wheels"):
        return lesson
    if run.kind == "learn-rigid":
        return {"held_out_m": 0.003}
    if run.kind == "bend":
        return {"bent_at": 20, "fixed_m": [0.004] * 20 + [0.03] * 180, "adapted_m": [0.004] * 200, "changes": 1}
    task = run.fields["task"].name
    return {
        "task": task, "label": run.fields["task"].target, "seed": 0, "outcome": "done", "reason": "", "sim_s": 20.0,
        "phases": [{"name": "search", "sim_s": 1.0}, {"name": "grasp", "sim_s": 2.0}], "trace": TRACE,
        "tasks": [TOUCHED] * (12 if task == "touch" else 1), "truth": FOLLOWED if task == "follow" else FETCHED,
        "body": {"wheel_separation_m": 0.256, "turning_separation_m": 0.255},
    }  # fmt: skip


@pytest.mark.process  # matplotlib asks a program for this machine's fonts, once
def test_the_report_has_tables_plots_and_verdicts_in_every_format(
    learned: tuple[ExperimentSettings, RunResult],
) -> None:
    settings, lesson = learned
    sections = []
    for experiment in EXPERIMENTS.values():
        results = {run.name: made_up(run, lesson) for run in experiment.runs(settings)}
        sections.append(experiment.section(settings, results))
    path = report.write(sections, settings, plots=True)
    text, page = path.read_text(), path.with_suffix(".html").read_text()
    for section in sections:
        assert f"## {section.key}: {section.title}" in text
        assert section.plots
        for plot in section.plots:
            assert 2_000 < (settings.out / f"{plot.name}.png").stat().st_size < 150_000
            assert f"]({plot.name}.png)" in text
    assert "<img" in page
    assert str(settings.out) not in text + page
    data = json.loads((settings.out / "report.json").read_text())
    held = {(row["measure"], row["held"]) for section in data["sections"] for row in section["rows"] if row["wanted"]}
    assert ("reached of 12, in view", True) in held
    assert ("fetched, of 3", True) in held
    manifest = json.loads((settings.out / "manifest.json").read_text())
    assert manifest["settings"]["seeds"] == [0]
    assert manifest["versions"]["numpy"] == np.__version__


def test_runs_that_could_not_be_are_reported_and_hold_nothing(learned: tuple[ExperimentSettings, RunResult]) -> None:
    settings, _ = learned
    for experiment in EXPERIMENTS.values():
        results = {run.name: {"error": "it broke"} for run in experiment.runs(settings)}
        section = experiment.section(settings, results)
        assert not any(row.held for row in section.rows)
        assert not section.plots
        json.dumps(section.data(), allow_nan=False)


# --- the command --------------------------------------------------------------------------------------


def test_an_unknown_experiment_is_refused_with_those_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "E9"]) == 2
    assert "known are E1, E2, E3, E4, E5, E6, all" in capsys.readouterr().err


def test_a_wrong_body_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "E1", "--body", "bent"]) == 2
    assert "nominal, worn" in capsys.readouterr().err


def test_progress_without_a_terminal_is_lines_of_what_runs_how_far_it_is_and_what_came_out() -> None:
    out, clock = io.StringIO(), Clock()
    progress = RunProgress(out, 2, clock)
    progress.begin(["babble-arm-0", "babble-wheels-0", "learn-0"], 1)
    progress.started("babble-arm-0")
    progress.started("babble-wheels-0")
    clock.now_s = 20.0
    progress.advanced("babble-arm-0", RehearsalProgress("babble-arm", 55.0, 0.1, "260 samples, coverage 40%"))
    progress.tick()
    clock.now_s = 30.0
    progress.ended("babble-wheels-0", {"outcome": "done", "said": "40 trials", "sim_s": 97.0})
    progress.ended("babble-arm-0", {"error": "it broke"})
    progress.close()
    assert out.getvalue().splitlines() == [
        "4 runs; 1 of them have a result already",
        "babble-arm-0 begins",
        "babble-wheels-0 begins",
        "20 s, 1 of 4 done: at least 3 min left; babble-arm-0 10% 260 samples, coverage 40%, babble-wheels-0",
        "2 of 4 babble-wheels-0 (30 s): done, 40 trials, 97 simulated s",
        "3 of 4 babble-arm-0 (30 s): it broke",
    ]


def test_the_time_left_is_that_of_ended_runs_of_the_same_kind() -> None:
    clock = Clock()
    left = TimeLeft([f"fetch-{seed}" for seed in range(5)], 2, clock)
    left.started("fetch-0")
    assert str(left) == ""
    clock.now_s = 20.0
    left.ended("fetch-0")
    assert str(left) == "about 40 s left"  # four runs of 20 s, two at a time


def test_progress_on_a_terminal_is_a_bar_the_runs_in_work_and_their_results(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    out = Terminal()
    progress = RunProgress(out)
    progress.begin(["babble-arm-0", "learn-0", "learn-1"], 1)
    progress.started("learn-0")
    progress.ended("babble-arm-0", {"outcome": "done"})
    progress.close()
    shown = out.getvalue()
    assert "2/4" in shown
    assert "learn-0" in shown
    assert "2 of 4 babble-arm-0: done" in shown


def test_a_worker_that_is_killed_fails_its_run_alone(tmp_path: Path) -> None:
    class Killer(Quiet):
        def started(self, name: str) -> None:
            if name == "one":
                self.begun.append(name)
                return
            super().started(name)

        def tick(self) -> None:
            for child in psutil.Process().children():
                if "--multiprocessing-fork" in child.cmdline() and len(self.begun) == 1:
                    child.kill()

    lost = {"arm": "a", "wheels": "w", "into": str(tmp_path / "m.json")}
    runs = [ExperimentRun("one", "rehearse", {"task": {"task": "babble-arm"}}), ExperimentRun("two", "learn", lost)]
    results = perform(runs, tmp_path / "runs", 1, Killer())
    assert results["one"] == {"error": "its process ended: killed by SIGKILL"}
    assert "No such file" in results["two"]["error"]


def test_the_terminal_is_as_before_when_the_experiments_end_with_an_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(_keys: Any, _settings: Any, progress: RunProgress, *, plots: bool) -> None:
        progress.begin(["one"], 1)
        raise OSError("the disk is full")

    out = Terminal()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", out)
    monkeypatch.setattr(experimenting, "run", fail)
    assert main(["experiment", "E3", "--out", str(tmp_path)]) == 1
    shown = out.getvalue()
    assert shown.index(HIDE_CURSOR) < shown.index(SHOW_CURSOR) < shown.index("the disk is full")


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True
