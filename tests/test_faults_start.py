"""A fault that prevents the start of a robot is reported in one line, without a crash."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from operator_shell import Shell

from apps.cli import exits

pytestmark = [pytest.mark.sim, pytest.mark.process]


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    with Shell(tmp_path) as shell:
        yield shell


def simulated(shell: Shell, **sim: object) -> str:
    settings = {"width": 64, "height": 48} | sim
    lines = "".join(f"{name} = {value!r}\n" for name, value in settings.items())
    return shell.profile("sim", extra=f'clock = "sim"\n[service.sim]\n{lines}')


def one_line(told: subprocess.CompletedProcess[str]) -> str:
    lines = (told.stdout + told.stderr).splitlines()
    assert len(lines) == 1, lines
    return lines[0]


# --- a missing GL library -----------------------------------------------------------------------------


@pytest.fixture
def no_gl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes find libraries that are none."""
    for name in ("libGL.so.1", "libEGL.so.1"):
        (tmp_path / name).touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))


@pytest.mark.usefixtures("no_gl")
def test_without_gl_the_robot_is_simulated_all_the_same_and_one_line_says_how_to_have_it(shell: Shell) -> None:
    assert shell("up", simulated(shell), "--detach").returncode == exits.DONE
    log = shell.run_dir.log("sim").read_text().splitlines()
    told = [line for line in log if "WARNING" in line or "ERROR" in line]
    assert len(told) == 1
    assert "slow pictures: no OpenGL on EGL here" in told[0]
    assert "apt install libegl1 libgl1 libgl1-mesa-dri" in told[0]


@pytest.mark.usefixtures("no_gl")
def test_who_demands_gl_where_there_is_none_is_told_in_a_line(shell: Shell) -> None:
    told = shell("up", simulated(shell, renderer="moderngl"))
    assert told.returncode == exits.USAGE
    line = one_line(told)
    assert line.startswith("sim ended (exit code 2) at its start: the moderngl renderer cannot run here")
    assert "apt install libegl1 libgl1 libgl1-mesa-dri" in line


# --- an unreadable scene ------------------------------------------------------------------------------


@pytest.fixture(params=["not text", "not TOML", "not a file", "not there"])
def unreadable(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    scene = tmp_path / "scene.toml"
    match request.param:
        case "not text":
            scene.write_bytes(b"\xff\xfe\x00")
        case "not TOML":
            scene.write_text("[[object]\n")
        case "not a file":
            scene.mkdir()
    return scene


def test_an_unreadable_scene_is_named_in_a_line(shell: Shell, unreadable: Path) -> None:
    for told in (
        shell("rehearse", "park", "--scene", str(unreadable)),
        shell("up", simulated(shell), "--scene", str(unreadable)),
        shell("up", simulated(shell, scene=str(unreadable))),
    ):
        assert told.returncode == exits.USAGE
        assert unreadable.name in one_line(told)
