"""`cocoro cockpit`: codes are printed, listed and ended, and what stands in the way is said in one line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from apps.cli import exits
from apps.cli.main import main
from deploy.rundir import RunDir
from services.cockpit.access_people import People, folder_of

ROBOT = "calliope"
URL = "https://robot.local:8770/"


@pytest.fixture
def people(root: Path) -> Iterator[People]:
    """A robot whose cockpit is open to others."""
    run_dir = RunDir(ROBOT, root)
    run_dir.make()
    found = People(folder_of(ROBOT))
    found.serves(URL)
    held = run_dir.claim("cockpit", ["cockpit"])
    yield found
    for claim in held:
        claim.release()


def give(*words: str) -> int:
    return main(["cockpit", *words, "--robot", ROBOT])


def test_a_code_is_printed_with_the_address_and_lets_in_as_its_role(
    people: People, capsys: pytest.CaptureFixture[str]
) -> None:
    assert give("invite", "viewer", "--name", "eve") == exits.DONE
    said = capsys.readouterr().out
    assert URL in said
    begun = people.log_in(said.splitlines()[0], "10.0.0.5")
    assert begun is not None
    assert (begun[1].name, begun[1].role) == ("eve", "viewer")


def test_codes_and_sessions_are_listed_and_ended(people: People, capsys: pytest.CaptureFixture[str]) -> None:
    assert give("invite", "operator", "--name", "ada", "--json") == exits.DONE
    code = json.loads(capsys.readouterr().out)["code"]
    assert give("list") == exits.DONE
    assert "invited" in capsys.readouterr().out
    begun = people.log_in(code, "10.0.0.5")
    assert begun is not None
    assert give("list", "--json") == exits.DONE
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["name"], row["role"], row["kind"], row["address"]) == ("ada", "operator", "session", "10.0.0.5")
    assert give("end", row["key"]) == exits.DONE
    assert "ada" in capsys.readouterr().out
    assert people.session(begun[0]) is None
    assert give("end", "all") == exits.DONE
    assert give("list") == exits.DONE
    assert "no codes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "code", "parts"),
    [
        (["invite", "king"], exits.USAGE, ["king", "viewer, operator"]),
        (["invite", "viewer", "--name", "a b"], exits.USAGE, ["--name"]),
        (["end", "nobody"], exits.USAGE, ["nobody", "no code"]),
    ],
)
def test_a_wrong_word_is_answered_in_one_line(
    people: People, capsys: pytest.CaptureFixture[str], words: list[str], code: int, parts: list[str]
) -> None:
    assert give(*words) == code
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    assert all(part in said for part in parts), said
    assert not people.listed()


def test_where_nobody_else_reaches_the_cockpit_no_code_is_made(
    people: People, capsys: pytest.CaptureFixture[str]
) -> None:
    people.serves(None)
    assert give("invite", "viewer") == exits.REFUSED
    assert "this machine alone" in capsys.readouterr().err


def test_where_no_cockpit_runs_no_code_is_made(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert give("invite", "viewer") == exits.REFUSED
    assert "no cockpit running" in capsys.readouterr().err
