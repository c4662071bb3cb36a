"""`cocoro site`: what its commands print, as text and as JSON, and what they say of a site that cannot work."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from site_rig import HALL, LAB

from apps.cli import exits
from apps.cli.main import main

Told = Callable[..., tuple[int, str, str]]


@pytest.fixture
def told(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Told:
    """Runs a command in the folder of the site LAB, whose certificates are all issued."""
    (tmp_path / "site.toml").write_text(LAB, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COCORO_SITE", raising=False)
    assert main(["pki", "init"]) == exits.DONE
    for role, name in (("robot", "body"), ("brain", "brain"), ("operator", "ada"), ("viewer", "eve")):
        assert main(["pki", "issue", role, name]) == exits.DONE
    capsys.readouterr()

    def run(*arguments: str) -> tuple[int, str, str]:
        code = main(["site", *arguments])
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def test_a_site_is_well_when_everybody_has_a_certificate(told: Told, tmp_path: Path) -> None:
    code, out, err = told("check")
    assert (code, err) == (exits.DONE, "")
    assert "site lab: 2 hosts, 1 robot, 2 persons" in out
    code, out, _ = told("check", str(tmp_path / "site.toml"), "--json")
    assert (code, json.loads(out)["problems"]) == (exits.DONE, [])


def test_what_is_missing_is_named_with_the_command_that_mends_it(told: Told, tmp_path: Path) -> None:
    more = LAB.replace("10.77.0.1", "10.77.0.8") + '[person.bob]\nrole = "author"\n'
    (tmp_path / "site.toml").write_text(more.replace('role = "viewer"', 'role = "operator"'), encoding="utf-8")
    code, _, err = told("check")
    assert code == exits.FAILED
    assert err.splitlines() == [
        "cocoro: body listens at 10.77.0.8, which its certificate does not name: "
        "cocoro pki renew body --address 10.77.0.8",
        "cocoro: eve is operator by the plan and viewer by its certificate: revoke it, issue it anew",
        "cocoro: bob has no certificate: cocoro pki issue author bob",
    ]
    code, out, _ = told("check", "--json")
    assert (code, len(json.loads(out)["problems"])) == (exits.FAILED, 3)


def test_a_plan_that_cannot_be_read_is_refused_in_a_line(told: Told, tmp_path: Path) -> None:
    code, out, err = told("show", str(tmp_path / "missing"))
    assert (code, out) == (exits.USAGE, "")
    assert err == f"cocoro: there is no site {tmp_path / 'missing'}: write one; `cocoro site --help` says more\n"
    (tmp_path / "site.toml").unlink()
    code, _, err = told("show")
    assert code == exits.USAGE
    assert "no site is set" in err


def test_the_plan_is_shown(told: Told) -> None:
    code, out, _ = told("show")
    assert code == exits.DONE
    rows = [line.split() for line in out.splitlines() if line]
    assert ["body", "robot", "calliope", "capture", "sim", "tls/10.77.0.1:7447"] in rows
    assert ["ada", "operator", "calliope"] in rows
    _, out, _ = told("show", "--json")
    assert json.loads(out)["hosts"]["brain"]["connect"] == ["body"]


def test_the_steps_to_a_running_site_are_commands(told: Told) -> None:
    _, out, _ = told("plan", "--json")
    commands = [step["command"] for step in json.loads(out)]
    assert "cocoro pki issue robot body --address 10.77.0.1" in commands
    assert "cocoro up --site DIR --host brain" in commands
    assert "cocoro status --site eve@DIR" in commands


def test_the_rules_are_a_table_of_keys_and_principals(told: Told) -> None:
    code, out, _ = told("rules")
    assert code == exits.DONE
    head, *rows = out.splitlines()
    assert head.split() == ["KEY", "BODY", "BRAIN", "ADA", "EVE", "AT", "MOST", "A", "SECOND"]
    by_key = {row.split()[0]: row for row in rows}
    assert by_key["calliope/base/command"].split() == [
        "calliope/base/command", "hear", "put", "hear", "hear", "64", "KiB", "500",
    ]  # fmt: skip
    assert by_key["calliope/executive/run"].split()[1:3] == ["answer", "ask"], "brain answers, ada alone asks"
    _, out, _ = told("rules", "--json")
    row = next(row for row in json.loads(out) if row["key"] == "executive/run")
    assert {name: may for name, may in row["may"].items() if may} == {"brain": ["answers"], "ada": ["asks"]}


def test_what_a_gateway_gives_to_zenoh_can_be_seen(told: Told) -> None:
    _, out, _ = told("rules", "--host", "body")
    control = json.loads(out)["access_control"]
    assert control["default_permission"] == "deny"
    assert {"id": "ada", "cert_common_names": ["ada.1", "ada.2"]} in control["subjects"]
    code, _, err = told("rules", "--host", "boddy")
    assert code == exits.USAGE
    assert "did you mean body" in err


def test_of_several_robots_one_is_chosen(told: Told, tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text(HALL, encoding="utf-8")
    code, _, err = told("rules")
    assert code == exits.USAGE
    assert "choose one: --robot a" in err
    code, out, _ = told("rules", "--robot", "b")
    assert code == exits.DONE
    assert "b/base/command" in out
    assert told("rules", "--robot", "c")[0] == exits.USAGE
