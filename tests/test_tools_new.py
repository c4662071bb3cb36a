"""`cocoro new service` and `cocoro new task`: what they write works, and what they refuse."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from apps.cli import new
from apps.cli.main import main

ROOT = Path(__file__).parent.parent
TEMPLATES = ROOT / "apps" / "templates"


@pytest.fixture
def written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """A component whose name is no Python name."""
    assert main(["new", "service", "depth-watch", "--into", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    folder = tmp_path / "depth-watch"
    assert all(str(path) in out for path in folder.rglob("*.py"))
    assert f"pip install -e {folder}" in out
    return folder


def test_a_new_service_has_core_shell_settings_messages_row_and_test(written: Path) -> None:
    names = {str(path.relative_to(written)) for path in written.rglob("*") if path.is_file()}
    package = {"__init__", "config", "core", "messages", "service"}
    assert names == {"README.md", "pyproject.toml", "tests/test_depth_watch.py"} | {
        f"depth_watch/{name}.py" for name in package
    }
    assert not any(re.search(r"\{\{|\}\}", path.read_text()) for path in written.rglob("*.*"))
    project = tomllib.loads((written / "pyproject.toml").read_text())["project"]
    assert project["name"] == "cocoro-depth-watch"
    assert project["entry-points"]["cocoro.components"] == {"depth-watch": "depth_watch:component"}


@pytest.mark.process
def test_its_tests_pass_and_it_is_clean(written: Path) -> None:
    def run(*command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-P", "-m", *command], cwd=written, capture_output=True, text=True, check=False
        )

    tests = run("pytest", "-q", "-p", "no:cacheprovider", "-W", "error")
    assert "6 passed" in tests.stdout, tests.stdout + tests.stderr
    for check in (("check", "--select", "E,F,I,N,UP,B,SIM,RUF"), ("format", "--check")):
        done = run("ruff", check[0], "--no-cache", *check[1:], ".")
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("Nearest", "is not a valid name"),
        ("9lives", "is not a valid name"),
        ("a/b", "is not a valid name"),
        ("base", "there is a service base already (process sim)"),
        ("planning", "there is a service planning already"),
        ("numpy", "there is a Python module numpy already"),
        ("class", "there is a Python module class already"),
        ("sim", "there is a service sim already"),
        ("services", "there is a Python module services already"),
    ],
)
def test_a_name_that_cannot_be_or_is_taken_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, complaint: str
) -> None:
    assert main(["new", "service", name, "--into", str(tmp_path)]) == 2
    assert complaint in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_never_written_over(written: Path, capsys: pytest.CaptureFixture[str]) -> None:
    core = written / "depth_watch" / "core.py"
    core.write_text("mine")
    assert main(["new", "service", "depth-watch", "--into", str(written.parent)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert core.read_text() == "mine"


def test_a_place_that_cannot_be_written_to_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert main(["new", "service", "nearest", "--into", str(tmp_path / "file")]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_the_templates_are_part_of_the_package() -> None:
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["apps"]
    packed = {path for pattern in patterns for path in (ROOT / "apps").glob(pattern)}
    files = {path for path in TEMPLATES.rglob("*") if path.is_file()}
    assert files <= packed
    words = {"name": "a", "package": "a", "class": "A"}
    assert len(files) == sum(len(list(new.files(template, words))) for template in (new.SERVICE, new.TASK))


@pytest.mark.process
def test_a_new_task_is_a_type_a_test_and_a_registration(tmp_path: Path) -> None:
    assert main(["new", "task", "wave-hand", "--into", str(tmp_path)]) == 0
    folder = tmp_path / "wave-hand"
    assert {path.name for path in folder.iterdir()} == {"pyproject.toml", "wave_hand.py", "test_wave_hand.py"}
    assert not any(re.search(r"\{\{|\}\}", path.read_text()) for path in folder.iterdir())
    done = subprocess.run(
        [sys.executable, "-P", "-m", "ruff", "check", "--no-cache", "--select", "E,F,N,UP,B,SIM", "."],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("fetch", "there is a task fetch already"),
        ("go-to", "there is a task go-to already"),
        ("status", "there is a command `cocoro status` already"),
        ("Wave", "is not a valid name"),
        ("numpy", "there is a Python module numpy already"),
    ],
)
def test_a_task_of_a_name_that_cannot_be_or_is_taken_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, complaint: str
) -> None:
    assert main(["new", "task", name, "--into", str(tmp_path)]) == 2
    assert complaint in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
