"""A fault that prevents the start of a robot is reported in one line, without a crash."""

from __future__ import annotations

import socket
import subprocess
import sys
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


# --- an occupied place --------------------------------------------------------------------------------


@pytest.fixture
def occupied() -> Iterator[str]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"tcp/127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize("detach", [(), ("--detach",)])
def test_an_occupied_port_is_named_in_a_line(shell: Shell, occupied: str, detach: tuple[str, ...]) -> None:
    told = shell("up", shell.profile("good", extra=f'[mesh]\nlisten = ["{occupied}"]\n'), *detach)
    assert told.returncode == exits.USAGE
    line = one_line(told)
    assert line.startswith(f"mesh of supervisor at {occupied}: another process listens there already; ")
    assert "[mesh]" in line


def test_a_component_whose_port_is_occupied_says_so_in_its_log_and_ends(shell: Shell, occupied: str) -> None:
    profile = shell.profile("good", extra=f'[mesh]\nlisten = ["{occupied}"]\n')
    told = shell("run", "good", "--profile", profile)
    assert told.returncode == exits.USAGE
    last = told.stderr.splitlines()[-1]
    assert f" ERROR   good: mesh of good at {occupied}: another process listens there already; " in last
    assert "[mesh]" in last
    assert "Traceback" not in told.stderr


def test_where_no_router_answers_it_is_named_in_a_line(shell: Shell) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
    told = shell("up", shell.profile("good", extra=f'[mesh]\nmode = "client"\nconnect = ["{endpoint}"]\n'))
    assert told.returncode == exits.USAGE
    assert one_line(told).startswith(f"no mesh at {endpoint}: no router answers there")


def test_a_run_directory_that_cannot_be_is_named_in_a_line(shell: Shell, tmp_path: Path) -> None:
    profile = shell.profile("good")
    place = tmp_path / "a file"
    place.touch()
    told = subprocess.run(
        [sys.executable, "-m", "apps.cli.main", "up", profile],
        env=shell.env | {"COCORO_RUN_DIR": str(place)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert told.returncode == exits.USAGE
    assert one_line(told).startswith(
        f"run directory {place}: Not a directory; put that right, or choose another by COCORO_RUN_DIR"
    )


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
