"""The command's usage: options, mistakes, exit codes; no robot needed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from places import in_short_folder

from apps.cli import app, listed, task_commands, terminal
from apps.cli.main import PACKAGES, main
from apps.cli.options import frames_of, latencies_of
from apps.cli.running import overrides
from apps.cli.terminal import Column, table
from apps.rehearsal import ahead
from apps.rehearsal import rehearse as rehearsing
from apps.rehearsal.request import RehearsalRequest
from cocoro.errors import CocoroError, ConfigError
from cocoro.stop import asking
from cocoro.topics import TOPICS
from deploy.processes import stoppable
from services.executive.tasks import TASKS, FetchTask, FollowTask, PutDownTask

COMMANDS = (
    "up", "down", "status", "fetch", "follow", "park", "put-down", "stop", "estop", "reset", "cancel", "objects",
    "snapshot", "run", "rehearse", "topics",
)  # fmt: skip
ROOT = Path(__file__).parent.parent


@pytest.fixture(autouse=True)
def no_robot_here(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with in_short_folder() as folder:
        monkeypatch.setenv("COCORO_RUN_DIR", str(folder))
        yield


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(f" {command} " in out for command in (*COMMANDS, "--version", "--install-completion"))


@pytest.mark.parametrize(
    "arguments",
    [
        ["no-such-command"],
        ["fetch"],
        ["fetch", "red_can", "--timeout", "-1"],
        ["up", "--frames", "big"],
        ["up", "--scene", "no_such_file.toml"],
        ["up", "no_such_profile"],
        ["up", "--latency", "perception"],
        ["up", "--set", "seed"],
        ["run", "no_such_process"],
        ["snapshot", "picture.jpg"],
        ["fetch", "red_can", "--snapshot", "picture.jpg"],
        ["estop", "now"],
        ["rehearse", "dance"],
        ["rehearse", "fetch"],
        ["rehearse", "follow"],
        ["rehearse", "fetch", "red_can", "--sensors", "good"],
        ["rehearse", "fetch", "red_can", "--seed", "-1"],
        ["rehearse", "fetch", "red_can", "--frames", "9x9@30"],
        ["rehearse", "fetch", "red_can", "--scene", "no_such_file.toml"],
    ],
    ids=" ".join,
)
def test_bad_usage_exits_with_2_and_no_traceback(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    "arguments",
    [
        ["fetch", "red_can"], ["park"], ["put-down"], ["cancel"], ["status"], ["objects"], ["snapshot", "out.png"],
        ["estop", "--robot", "nobody"], ["stop", "--robot", "nobody"], ["reset"],
        ["fetch", "red_can", "--robot", "calliope"],
    ],
    ids=" ".join,
)  # fmt: skip
def test_without_a_robot_they_exit_with_4_and_say_what_to_start(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 4
    assert "cocoro up sim" in capsys.readouterr().err


def test_down_without_a_robot_is_no_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["down"]) == 0
    assert capsys.readouterr().out == "nothing was up\n"


def test_the_options_of_up_are_settings_of_the_simulator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").touch()
    settings = overrides("mine.toml", 7, "real", "worn", "320x240@15", ["perception=0.5"], ["robot=robbie"])
    assert settings == [
        f'service.sim.scene="{tmp_path}/mine.toml"', "service.sim.seed=7", 'service.sim.sensors="real"',
        'service.sim.body="worn"',
        "service.sim.width=320", "service.sim.height=240", "service.sim.frame_rate_hz=15.0",
        "service.perception.latency_s=0.5", "robot=robbie",
    ]  # fmt: skip
    assert overrides("paper", None, None, None, None, [], []) == ['service.sim.scene="paper"']


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--scene", "papr"], "did you mean paper?"),
        (["--sensors", "idael"], "known are ideal, real; did you mean ideal?"),
        (["--body", "wron"], "known are nominal, worn; did you mean worn?"),
        (["--reach", "lerned"], "known are learned, rigid; did you mean learned?"),
        (["--set", "robot=Upper"], "robot: a name has 1 to 32 small letters, digits, '-' and '_'"),
    ],
)
def test_up_refuses_a_value_that_is_none_before_it_starts_anything(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("apps.cli.running.supervise", lambda *_: pytest.fail("it was started"))
    assert main(["up", *arguments]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--sensors", "idael"], ["--body", "nominl"], ["--reach", "learnd"]])
def test_rehearse_lists_the_values_that_there_are(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rehearse", "fetch", "red_can", *arguments]) == 2
    said = capsys.readouterr().err
    assert f"{arguments[0][2:]}: unknown value" in said
    assert "did you mean" in said


def test_frames_may_leave_the_rate_out() -> None:
    assert frames_of("640x480") == {"width": 640, "height": 480}


@pytest.mark.parametrize("text", ["perception", "=1", "perception=", "perception=soon"])
def test_a_latency_that_is_none_shows_how_it_is_written(text: str) -> None:
    with pytest.raises(ConfigError, match=r"perception=0\.5"):
        latencies_of([text])


def test_a_table_lines_up() -> None:
    assert table(("name", "n"), [("a", "1"), ("long", "22")]) == "NAME  N\na     1\nlong  22\n"


@pytest.mark.parametrize("width", [13, 14, 100])
def test_a_table_that_needs_no_fitting_is_what_the_library_draws(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    columns = ("name", Column("n", right=True), Column("", text=True))
    rows = [("a", "1", ""), ("long", "22", "as [b]"), ("", "", "x"), ("", "", "")]
    ours = table(columns, rows, width)
    monkeypatch.setattr(terminal, "_plain_table", lambda *_: None)
    assert ours == table(columns, rows, width)


def test_topics_as_data_has_every_row(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["topics", "--json"]) == 0
    assert [row["topic"] for row in json.loads(capsys.readouterr().out)] == [topic.name for topic in TOPICS]


def test_the_topics_page_of_the_documentation_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["topics", "--markdown"]) == 0
    page = (ROOT / "docs" / "topics.md").read_text(encoding="utf-8")
    assert capsys.readouterr().out == page, "make it anew: cocoro topics --markdown > docs/topics.md"


@pytest.mark.process
def test_help_imports_no_command() -> None:
    """Where typer draws it, as on a narrow terminal; elsewhere it imports less."""
    code = "import sys; from apps.cli.main import main; main(['--help']); print(*sys.modules, file=sys.stderr)"
    environment = os.environ | {"COLUMNS": "50"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT, env=environment
    )
    modules = set(done.stderr.split())
    heavy = {"numpy", "zenoh", "psutil", "rich.live", "apps.cli.link", "apps.cli.status", "services.executive.skills"}
    assert heavy & modules == set()
    assert "services.executive.tasks" in modules, "the tasks' own types say what they are called"


@pytest.mark.process
def test_a_command_that_is_no_task_imports_no_task() -> None:
    code = "import sys; from apps.cli.main import main; main(['down', '--help']); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert "services.executive.tasks" not in done.stderr.split()


def test_a_task_of_the_project_is_found_without_a_search_for_third_parties(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TASKS, "_others", lambda: pytest.fail("the search takes 40 ms"))
    assert task_commands.task_command("fetch") is not None
    assert task_commands.task_command("babble-arm") is None
    assert task_commands.RehearsalGroup().get_command(None, "babble-arm") is not None


@pytest.mark.parametrize("row", listed.COMMANDS, ids=lambda row: row.name)
def test_a_commands_own_help_begins_with_its_line_of_the_list(row: listed.CommandRow) -> None:
    command = app.load(row.name)
    assert " ".join((command.help or "").split()).startswith(row.summary)
    assert not command.hidden


@pytest.mark.process
def test_the_emergency_stop_imports_next_to_nothing() -> None:
    code = "import sys; from apps.cli import main, estop; estop.by_path('nobody'); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    modules = set(done.stdout.split())
    assert {name for name in modules if name.partition(".")[0] in PACKAGES} == {
        "apps", "cocoro", "deploy", "apps.cli", "apps.cli.main", "apps.cli.exits", "apps.cli.output", "apps.cli.estop",
        "apps.cli.stop_result", "cocoro.stop", "cocoro.stop.asking", "deploy.quit",
    }  # fmt: skip
    assert modules.isdisjoint({"asyncio", "argparse", "json", "pathlib", "typing_extensions", "msgspec", "zenoh"})


def test_the_emergency_stop_knows_what_can_be_stopped() -> None:
    assert stoppable() == asking.STOPPABLE


@pytest.mark.process
def test_a_foreign_package_that_hides_one_of_ours_is_named(tmp_path: Path) -> None:
    (tmp_path / "services").mkdir()
    (tmp_path / "services" / "__init__.py").touch()
    # An editable installation finds the modules of a hidden package all the same; a wheel's does not.
    code = (
        "import sys; sys.meta_path = [finder for finder in sys.meta_path if 'editable' not in finder.__module__]; "
        "from apps.cli.main import main; sys.exit(main(['doctor', 'sim']))"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), str(ROOT)))},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"'services' in {tmp_path} hides" in done.stderr


# --- rehearse -------------------------------------------------------------------------------------

RESULT: dict[str, Any] = {
    "task": "fetch", "label": "red_can", "seed": 3, "outcome": "done", "reason": "", "sim_s": 12.5, "wall_s": 5.0,
    "phases": [{"name": "approach", "sim_s": 4.0}],
    "truth": {"lifted_m": 0.17, "held": True, "knocked_over": [], "collisions": 0},
}  # fmt: skip


@pytest.fixture
def simulator(monkeypatch: pytest.MonkeyPatch) -> list[RehearsalRequest]:
    """Stands in for the simulator; the requests that it got. It prints, as libraries do."""
    asked: list[RehearsalRequest] = []

    def run(request: RehearsalRequest, _tell: object) -> dict[str, Any]:
        asked.append(request)
        print("pybullet build time: today", flush=True)
        return RESULT | {"outcome": "failed" if request.task.label == "blue_can" else "done"}

    monkeypatch.setattr(rehearsing, "rehearse", run)
    monkeypatch.setattr(ahead, "begun_ahead", nullcontext)
    return asked


def test_every_option_of_rehearse_reaches_the_request(simulator: list[RehearsalRequest]) -> None:
    options = (
        "--bring --scene paper --seed 3 --sensors real --latency perception=0.1 --latency planning=0.02 --lockstep"
    )
    code = main(["rehearse", "fetch", "red_can", *options.split(), "--frames", "320x240@15", "--timeout", "60"])
    assert code == 0
    assert simulator == [
        RehearsalRequest(
            task=FetchTask(label="red_can", bring=True), scene="paper", seed=3, sensors="real",
            latency={"perception": 0.1, "planning": 0.02}, lockstep=True,
            width=320, height=240, frame_rate_hz=15.0, timeout_s=60.0, camera_process=True,
        )
    ]  # fmt: skip


def test_the_world_may_run_before_and_tasks_may_follow_each_other(
    simulator: list[RehearsalRequest], capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["rehearse", "fetch", "red_can", "--wait", "4", "--then", "put-down", "--then", "follow b --for 20"]) == 0
    )
    assert simulator[0].wait_s == 4.0
    assert simulator[0].then == (PutDownTask(), FollowTask(label="b", for_s=20.0))
    for wrong in ("dance", "follow", "follow b --for long", "--help", "", "put-down '"):
        assert main(["rehearse", "fetch", "red_can", "--then", wrong]) == 2
        assert f"--then {wrong!r}: " in capsys.readouterr().err
    assert len(simulator) == 1


def test_json_is_all_that_stands_on_the_output(
    simulator: list[RehearsalRequest], capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["rehearse", "fetch", "red_can", "--json"]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out) == RESULT
    assert "pybullet" in err


def test_the_summary_says_outcome_phases_speed_and_truth(
    simulator: list[RehearsalRequest], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rehearse", "fetch", "blue_can"]) == 1
    out = capsys.readouterr().out
    assert "failed: fetch red_can in 12.5 s" in out
    for fact in ("approach      4.0 s", "2.5 times real time", "held               yes", "knocked over       none"):
        assert fact in out


@pytest.mark.parametrize(("refusal", "code"), [("unknown_label", 2), ("busy", 3)])
def test_a_refused_rehearsal_exits_as_the_refused_task_would(
    simulator: list[RehearsalRequest], monkeypatch: pytest.MonkeyPatch, refusal: str, code: int
) -> None:
    def refuse(request: RehearsalRequest, _tell: object) -> dict[str, Any]:
        error = CocoroError("known are red_can")
        error.code = refusal  # type: ignore[attr-defined]
        raise error

    monkeypatch.setattr(rehearsing, "rehearse", refuse)
    assert main(["rehearse", "fetch", "grey_can"]) == code


@pytest.mark.process
@pytest.mark.sim
def test_a_scene_with_an_error_is_bad_usage_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text('name = "x"\n[[object]]\nlabel = "red_can"\nshape = "cone"\n')
    assert main(["rehearse", "fetch", "red_can", "--scene", str(scene)]) == 2
    assert "shape" in capsys.readouterr().err
