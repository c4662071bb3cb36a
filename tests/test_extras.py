"""Installations by parts: a missing library is named with the extra that has it, and installing shows its progress."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from apps.cli import exits, main
from cocoro.component import Component
from deploy import extras, install_progress
from deploy.processes import COMPONENTS
from deploy.rundir import RunDir

ROOT = Path(__file__).parent.parent
REQUIRES = [
    "numpy>=2.2",
    'opencv-python-headless>=4.13; extra == "operator"',
    'cocoro-mesh[operator]; extra == "robot"',
    'cocoro-mesh[robot]; extra == "sim"',
    'scipy>=1.15; extra == "robot"',
    'pybullet>=3.2.7; extra == "sim"',
    'pybullet; extra == "dev"',
]


@pytest.fixture(autouse=True)
def declared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.requires", lambda _name: REQUIRES)


def test_a_missing_library_is_advised_with_the_smallest_extra_that_has_it() -> None:
    assert extras.advice("pybullet") == "pip install 'cocoro-mesh[sim]'"
    assert extras.advice("scipy") == "pip install 'cocoro-mesh[robot]'"
    assert extras.advice("scipy", "pybullet") == "pip install 'cocoro-mesh[sim]'"
    assert extras.advice("left-pad") == "pip install left-pad"


def test_a_command_whose_library_is_missing_names_the_extra(capsys: pytest.CaptureFixture[str]) -> None:
    error = ModuleNotFoundError("No module named 'cv2'", name="cv2")
    assert "cocoro-mesh[sim]" in (extras.advice_of(error, "rehearse") or "")
    assert main.failed(error) == exits.USAGE
    said = capsys.readouterr().err
    assert "needs opencv-python-headless" in said
    assert "pip install 'cocoro-mesh[operator]'" in said
    assert main.failed(ModuleNotFoundError("No module named 'left_pad'", name="left_pad")) == exits.FAILED


def test_up_refuses_a_robot_whose_libraries_are_missing_before_it_starts_anything(
    root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(extras, "missing", lambda _rows: iter(["scipy", "pybullet"]))
    assert main.main(["up", "sim", "--detach"]) == exits.USAGE
    assert "cocoro-mesh[sim]" in capsys.readouterr().err
    assert not RunDir("calliope").path.exists()


def test_what_is_installed_is_not_missing() -> None:
    component = Component(name="x", module="x", doc="", libraries=("numpy", "pyserial", "left-pad"))
    assert list(extras.missing([component])) == ["left-pad"]


def test_every_library_of_the_projects_components_is_in_an_extra() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    parts = [*project["dependencies"], *(line for lines in project["optional-dependencies"].values() for line in lines)]
    names = {part.partition(">")[0] for part in parts}
    for component in COMPONENTS:
        assert set(component.libraries) <= names
    assert set(project["optional-dependencies"]) == set(extras.EXTRAS)


def test_installing_says_which_package_it_is_at_and_what_goes_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    pip = """Looking in links: /wheels
Collecting numpy==2.4.6
  Downloading numpy-2.4.6-cp311-cp311-manylinux.whl (16.9 MB)
Collecting scipy
  Using cached scipy-1.17.1-cp311-cp311-manylinux.whl (35.2 MB)
Processing /wheels/mcap-1.6.0-py3-none-any.whl
Installing collected packages: numpy, scipy, mcap
ERROR: No matching distribution found for left-pad
"""
    install_progress.follow(pip.splitlines(), install_progress.Progress())
    assert capsys.readouterr().out.splitlines() == [
        "  package 1: numpy (16.9 MB)", "  package 2: scipy (35.2 MB)", "  package 3: mcap",
        "  unpacking 3 packages", "ERROR: No matching distribution found for left-pad",
    ]  # fmt: skip


def test_the_sizes_of_packages_are_listed_from_the_largest_on(capsys: pytest.CaptureFixture[str]) -> None:
    found = install_progress.sizes()
    assert found["numpy"] > 10_000_000
    assert list(found.values()) == sorted(found.values(), reverse=True)
