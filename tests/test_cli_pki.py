"""`cocoro pki`: what its commands print, as text and as JSON, their exit codes, and what `cocoro doctor` says."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from site_rig import LAB

from apps.cli import exits, pki
from apps.cli.main import main
from deploy.site import authority
from deploy.site.checks import SOON_DAYS, certificate_checks

DAY = timedelta(days=1)
Said = Callable[..., tuple[int, str, str]]
Told = Callable[..., Any]


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    """Gives a command: its exit code, what it printed, and what it complained of."""

    def give(*arguments: str) -> tuple[int, str, str]:
        code = main(["pki", *arguments])
        found = capsys.readouterr()
        return code, found.out, found.err

    return give


@pytest.fixture
def told(said: Said) -> Told:
    """The JSON of a command that succeeds."""

    def give(*arguments: str) -> Any:
        code, out, err = said(*arguments, "--json")
        assert (code, err) == (exits.DONE, "")
        return json.loads(out)

    return give


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a site without an authority, by the environment variable."""
    monkeypatch.setenv("COCORO_SITE", str(tmp_path / "lab"))
    return tmp_path / "lab"


def test_a_site_is_begun_and_its_certificates_are_issued_renewed_revoked_and_listed(site: Path, told: Told) -> None:
    begun = told("init")
    assert begun["authority"] == str(site / "authority")
    issued = told("issue", "robot", "base", "--address", "10.77.0.1", "--address", "base.local")
    assert (issued["common_name"], issued["role"], issued["days_left"]) == ("base.1", "robot", 90)
    assert issued["addresses"] == ["10.77.0.1", "base.local"]
    assert Path(issued["folder"]) == site / "credentials" / "base"
    told("issue", "operator", "ada", "--days", "5")
    assert told("renew", "base")["common_name"] == "base.2"
    assert told("revoke", "ada") == {"revoked": ["ada.1"], "admitted": str(site / "admitted.toml")}
    rows = told("list")
    keys = ("name", "role", "generation", "revoked", "state")
    assert [tuple(row[key] for key in keys) for row in rows] == [
        ("base", "robot", 1, False, "valid"),
        ("ada", "operator", 1, True, "revoked"),
        ("base", "robot", 2, False, "valid"),
    ]
    assert {row["days_left"] for row in rows} <= {90, 89, 5, 4}


def test_the_list_is_a_table_whose_exit_code_is_0_with_what_has_expired(
    site: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    said("init")
    assert said("list")[:2] == (
        exits.DONE,
        f"no certificates in {site / 'admitted.toml'}: `cocoro pki issue ROLE NAME` issues one\n",
    )
    said("issue", "viewer", "vera", "--days", "3")
    said("issue", "author", "ben")
    later = datetime.now(UTC) + 10 * DAY
    monkeypatch.setattr(pki, "_now", lambda: later)
    code, out, err = said("list")
    assert (code, err) == (exits.DONE, "")
    head, vera, ben = [line.split() for line in out.splitlines()]
    assert head[:4] == ["NAME", "ROLE", "GENERATION", "EXPIRES"]
    assert (vera[:3], vera[-2:]) == (["vera", "viewer", "1"], ["0", "expired"])
    assert (ben[:3], ben[-1]) == (["ben", "author", "1"], "valid")


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["init"], exits.REFUSED, "there already"),
        (["issue", "robot", "base"], exits.REFUSED, "cocoro pki renew base"),
        (["issue", "robto", "x"], exits.USAGE, "did you mean robot?"),
        (["issue", "robot", "../x"], exits.USAGE, "small letters"),
        (["issue", "robot", "--", "-x"], exits.USAGE, "small letters"),
        (["issue", "robot", "-x"], exits.USAGE, "-x"),
        (["issue", "robot", "a\nb"], exits.USAGE, "'a\\nb'"),
        (["issue", "robot", "x", "--days", "0"], exits.USAGE, "--days"),
        (["issue", "robot", "x", "--days", "4000"], exits.USAGE, "--days"),
        (["issue", "robot", "x", "--address", "10.77"], exits.USAGE, "neither an IP address"),
        (["renew", "bsae"], exits.USAGE, "did you mean base?"),
        (["revoke", "nobody"], exits.USAGE, "known are base"),
        (["list", "--site", "/nowhere/at/all"], exits.USAGE, "no such folder"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(
    arguments: list[str], code: int, words: str, site: Path, said: Said
) -> None:
    said("init")
    said("issue", "robot", "base")
    found, out, err = said(*arguments)
    assert (found, out) == (code, "")
    assert words in err
    if "Usage:" not in err:
        assert len(err.splitlines()) == 1
    at = arguments.index("--") if "--" in arguments else len(arguments)
    found, out, _ = said(*arguments[:at], "--json", *arguments[at:])
    assert found == code
    assert words in json.loads(out)["error"]["text"]


def test_without_a_site_it_is_told_how_to_set_one(said: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COCORO_SITE", raising=False)
    monkeypatch.chdir(tmp_path)
    code, _, err = said("list")
    assert code == exits.USAGE
    assert "--site" in err
    assert "COCORO_SITE" in err
    (tmp_path / "site.toml").touch()
    assert said("init")[0] == exits.DONE
    assert (tmp_path / "authority").is_dir()
    assert said("list", "--site", ".")[0] == exits.DONE


def test_no_command_prints_a_key(site: Path, said: Said) -> None:
    printed = ""
    for words in (["init"], ["issue", "robot", "base"], ["renew", "base"], ["list"]):
        for more in ([], ["--json"]):
            printed += "".join(said(*words, *more)[1:])
    keys = [path.read_text() for path in (*site.rglob("*.key"), *site.rglob("key.pem"))]
    assert len(keys) == 2
    assert not any(line in printed for key in keys for line in key.splitlines())


@pytest.mark.parametrize(
    ("line", "some"),
    [("cocoro pki re", {"renew", "revoke"}), ("cocoro pki issue vi", {"viewer"}), ("cocoro pki renew ba", {"base"})],
)
def test_the_shell_completes_roles_and_names(
    line: str,
    some: set[str],
    site: Path,
    said: Said,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    said("init")
    said("issue", "robot", "base")
    monkeypatch.setenv("_COCORO_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split()) - 1))
    assert main([]) == 0
    assert {*capsys.readouterr().out.split()} == some


@pytest.mark.process
@pytest.mark.parametrize("words", [["--help"], ["issue", "--help"], ["list"]])
def test_only_what_issues_waits_for_the_library(words: list[str], site: Path, said: Said) -> None:
    said("init")
    code = f"import sys; from apps.cli.main import main; main(['pki', *{words}]); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stderr.split()}
    assert done.stdout
    assert not {"cryptography", "numpy", "zenoh", "cv2"} & loaded


def test_without_the_library_the_extra_is_named(site: Path, said: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("deploy.site.authority", "deploy.site.credentials"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setattr("deploy.site.authority", None, raising=False)
    monkeypatch.delattr("deploy.site.authority")
    monkeypatch.setattr("importlib.metadata.requires", lambda _name: ['cryptography>=45; extra == "site"'])
    monkeypatch.setitem(sys.modules, "cryptography", None)
    code, _, err = said("init")
    assert code == exits.USAGE
    assert "pip install 'cocoro-mesh[site]'" in err
    assert not site.exists()


# --- cocoro doctor ----------------------------------------------------------------------------------

NOW = datetime(2031, 5, 1, tzinfo=UTC)


def checks(site: Path, now: datetime) -> dict[str, tuple[str, str]]:
    return {check.name: (check.state, check.text) for check in certificate_checks(site, now)}


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """Two names, of which one has its credentials here."""
    site = tmp_path / "lab"
    authority.init(site, NOW)
    authority.issue(site, "robot", "base", NOW)
    authority.issue(site, "operator", "ada", NOW, days=60)
    (site / "credentials" / "ada").rename(tmp_path / "ada")
    return site


def test_doctor_names_what_expires_within_14_days_and_what_has_expired(lab: Path) -> None:
    assert {name: state for name, (state, _) in checks(lab, NOW).items()} == {"credentials of base": "ok", "site": "ok"}
    assert checks(lab, NOW + (60 - SOON_DAYS) * DAY)["site"][0] == "ok"
    state, text = checks(lab, NOW + (61 - SOON_DAYS) * DAY)["site"]
    assert (state, "ada.1 expires in 13 days" in text) == ("note", True)
    assert "ada.1 has expired" in checks(lab, NOW + 60 * DAY)["site"][1]
    assert "1 day:" in checks(lab, NOW + 58.5 * DAY)["site"][1]
    state, text = checks(lab, NOW + 80 * DAY)["credentials of base"]
    assert (state, "in 10 days: `cocoro pki renew base`" in text) == ("note", True)
    state, text = checks(lab, NOW + 90 * DAY)["credentials of base"]
    assert (state, "cocoro pki renew base" in text) == ("bad", True)


def test_doctor_names_credentials_that_are_old_revoked_or_of_another(lab: Path, tmp_path: Path) -> None:
    former = (lab / "credentials" / "base").rename(tmp_path / "former")
    authority.renew(lab, "base", NOW)
    (lab / "credentials" / "base").rename(tmp_path / "next")
    former.rename(lab / "credentials" / "base")
    state, text = checks(lab, NOW)["credentials of base"]
    assert (state, "base.2 is issued" in text) == ("note", True)
    authority.revoke(lab, "base")
    (tmp_path / "next").rename(lab / "credentials" / "base")
    state, text = checks(lab, NOW)["credentials of base"]
    assert (state, "base.2 is revoked" in text) == ("bad", True)
    (lab / "credentials" / "base").rename(lab / "credentials" / "ada")
    assert checks(lab, NOW)["credentials of ada"][0] == "bad"


def test_doctor_says_nothing_of_sites_without_one_and_names_a_damaged_one(
    root: Path, lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for given, found in ((None, False), (str(lab), True)):
        monkeypatch.setenv("COCORO_SITE", given) if given else monkeypatch.delenv("COCORO_SITE", raising=False)
        main(["doctor", "sim", "--json"])
        names = [check["name"] for check in json.loads(capsys.readouterr().out)]
        assert ("site" in names) == found
    (lab / "admitted.toml").write_text("authority = 1\n")
    state, text = checks(lab, NOW)["site"]
    assert (state, "authority" in text) == ("bad", True)


def test_a_certificate_has_the_role_and_the_addresses_of_the_plan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "site.toml").write_text(LAB, encoding="utf-8")
    at = ("--site", str(tmp_path))
    assert main(["pki", "init", *at]) == exits.DONE
    assert main(["pki", "issue", "robot", "body", *at]) == exits.DONE
    assert "at 10.77.0.1" in capsys.readouterr().out
    assert main(["pki", "issue", "operator", "eve", *at]) == exits.USAGE
    assert "eve is viewer by " in capsys.readouterr().err
