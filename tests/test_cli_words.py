"""Every command: help in which nothing is lost, JSON for results and errors, names that the shell completes."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from places import in_short_folder
from urdf_rig import desk_arm

from apps.cli import manual
from apps.cli.listening import nothing_on
from apps.cli.main import main
from apps.cli.output import asks_json, print_json
from apps.cli.walk import commands
from cocoro.errors import choice_of

COMMANDS = {" ".join(words): command for words, command, _ in commands()}
TELLS_NOTHING = {
    "estop": "it reads its own --json, without typer",
    "stop": "it reads its own --json, without typer",
    "drive": "it is steered from the keyboard, and shows on the terminal what the robot does",
    "run": "its output is the log of a process",
    "view": "it opens a window",
    "replay": "it publishes until its end, steered from the keyboard",
    "kinect tilt": "it prints nothing",
    "servos calibrate": "a dialogue with a person",
    "servos limits": "a dialogue with a person",
}


@pytest.fixture(autouse=True)
def no_robot_here(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with in_short_folder() as folder:
        monkeypatch.setenv("COCORO_RUN_DIR", str(folder))
        yield


def test_no_help_loses_what_stands_in_brackets(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 400)
    lost = []
    for words, command, context in commands():
        texts = [command.help or "", *(getattr(param, "help", None) or "" for param in command.params)]
        wanted = {found for text in texts for found in re.findall(r"\[[^\]\s]+\]", text.replace("\\[", "["))}
        print(command.get_help(context))
        out = capsys.readouterr().out
        assert "Usage: " in out, words
        lost += [f"{' '.join(words)}: {found}" for found in wanted if found not in out]
    assert not lost


def test_every_command_that_tells_something_has_json() -> None:
    without = [
        name
        for name, command in COMMANDS.items()
        if not any("--json" in param.opts for param in command.params)
        and not (hasattr(command, "commands") and not command.invoke_without_command)
    ]
    assert sorted(without) == sorted(TELLS_NOTHING)


@pytest.mark.parametrize(
    ("arguments", "code", "name", "words"),
    [
        (["status"], 4, "no_mesh", "no robot is up"),
        (["fetch", "red_can"], 4, "no_mesh", "no robot is up"),
        (["fetch"], 2, "usage", "LABEL"),
        (["fetch", "red_can", "--timeout", "-1"], 2, "usage", "--timeout"),
        (["logs", "--level", "erorr"], 2, "usage", "did you mean error?"),
        (["hz", "a//b"], 4, "no_mesh", "no robot is up"),
        (["ftch", "red_can"], 2, "usage", "Did you mean 'fetch'"),
        (["rehearse", "ftch", "red_can"], 2, "usage", "did you mean fetch?"),
        (["estop", "--robot", "nobody"], 4, "no_mesh", "no nobody is up"),
    ],
)
def test_an_error_is_one_object_on_standard_output_where_json_is_asked_for(
    arguments: list[str], code: int, name: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, "--json"]) == code
    said = capsys.readouterr()
    error = json.loads(said.out)["error"]
    assert (error["code"], error["exit_code"]) == (name, code)
    assert words in error["text"]
    assert said.err
    assert main(arguments) == code
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("arguments", "keys"),
    [
        (["down"], {"down"}),
        (["new", "service", "greeter"], {"files", "next"}),
        (["new", "task", "greet"], {"files", "next"}),
        (["new", "robot", "ada", "--urdf", "desk.urdf"], {"files", "next"}),
        (["doctor", "sim"], None),
        (["topics"], None),
        (["capture", "list"], None),
    ],
)
def test_a_result_is_one_document_of_json(
    arguments: list[str],
    keys: set[str] | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COCORO_CAPTURE_DIR", str(tmp_path))
    desk_arm(tmp_path)
    main([*arguments, "--json"])
    result = json.loads(capsys.readouterr().out)
    assert isinstance(result, list) if keys is None else result.keys() == keys


def test_what_json_lacks_is_null(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"rate_hz": float("nan"), "gaps": [1.5, float("inf")]})
    assert capsys.readouterr().out == '{"rate_hz": null, "gaps": [1.5, null]}\n'


def test_json_is_asked_for_before_the_end_of_the_options_alone() -> None:
    assert asks_json(["new", "task", "a", "--json"])
    assert not asks_json(["new", "task", "--", "--json"])


def test_the_manual_page_is_up_to_date_and_describes_every_command() -> None:
    text = (Path(__file__).parent.parent / "docs" / "cocoro.1").read_text()
    assert text == manual.page(), "make manual"
    headings = re.findall(r'^\.SS "cocoro ([^"]*)"$', text, re.MULTILINE)
    plain = [heading.replace("\\-", "-") for heading in headings]
    for words, command, _ in commands():
        if words and words[0] != "rehearse" and not hasattr(command, "commands"):
            assert any(f"{heading} ".startswith(f"{' '.join(words)} ") for heading in plain), words


def test_version_names_what_matters_in_a_report(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert re.fullmatch(r"cocoro-mesh \d+\.\d+\S*, python 3\.\S+, zenoh \d+\.\S+\n", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("given", "known", "text"),
    [
        ("red_cn", ["blue_can", "red_can"], "known are blue_can, red_can; did you mean red_can?"),
        ("teapot", ["blue_can", "red_can"], "known are blue_can, red_can"),
        ("x", [], "known are none"),
    ],
)
def test_a_wrong_name_is_answered_by_those_that_are_known(given: str, known: list[str], text: str) -> None:
    assert choice_of(given, known) == text


def test_a_key_that_nobody_knows_is_answered_by_one_that_is_like_it() -> None:
    assert nothing_on("calliope/arm/stat").endswith("did you mean arm/state?")
    assert "did you mean" not in nothing_on("calliope/arm/state")
    assert "did you mean" not in nothing_on("calliope/parts/**")


@pytest.mark.parametrize(
    ("line", "some"),
    [
        ("cocoro f", {"fetch", "follow"}),
        ("cocoro fetch red", {"red_can"}),
        ("cocoro rehearse go-to gre", {"green_can"}),
        ("cocoro up --scene ra", {"random"}),
        ("cocoro up rob", {"robot"}),
        ("cocoro up --sensors r", {"real"}),
        ("cocoro echo planning/s", {"planning/status", "planning/steps"}),
        ("cocoro logs per", {"perception"}),
        ("cocoro logs --level e", {"error"}),
        ("cocoro run exec", {"executive"}),
        ("cocoro capture i", {"info"}),
        ("cocoro fetch --robot nob", set()),
    ],
)
def test_the_shell_completes_names(
    line: str, some: set[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_COCORO_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split()) - 1))
    assert main([]) == 0
    found = set(capsys.readouterr().out.split())
    assert some <= found
    assert all(name.startswith(line.split()[-1]) for name in found)


@pytest.mark.process
@pytest.mark.parametrize("line", ["cocoro replay l", "cocoro up --scene p"])
def test_a_completion_waits_for_no_heavy_library(line: str) -> None:
    code = "import sys; from apps.cli.main import main; main([]); print(*sys.modules, file=sys.stderr)"
    environment = {"_COCORO_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ | environment
    )
    assert done.stdout
    assert not {"numpy", "cv2", "scipy", "pybullet"} & {*done.stderr.split()}


def test_a_completion_that_fails_completes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    from apps.cli import completions

    def fail(*_: Any) -> Any:
        raise RuntimeError

    monkeypatch.setattr("deploy.rundir.robots", fail)
    assert completions.robots("") == []
