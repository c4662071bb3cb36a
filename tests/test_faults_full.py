"""A robot whose machine has no room: its shared memory or its run directory is too small, or fills while it runs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from namespace_rig import Namespace, needs_root
from operator_shell import Shell

from apps.cli import exits
from cocoro.bus import shared

pytestmark = [pytest.mark.zenoh, needs_root, pytest.mark.process]


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    with Shell(tmp_path) as shell:
        yield shell


@contextmanager
def inside(shell: Shell, mounts: dict[Path, str]) -> Iterator[Namespace]:
    """The shell's commands run in a namespace; what is up there goes down at the end."""
    with Namespace(mounts) as namespace:
        shell.prefix = namespace.prefix
        try:
            yield namespace
        finally:
            shell("down")
            shell.prefix = []


def small(shell: Shell) -> str:
    """A simulated robot with small frames; their pool is as large as of every robot."""
    return shell.profile("sim", extra='clock = "sim"\n[service.sim]\nwidth = 64\nheight = 48\n')


def segments(namespace: Namespace) -> dict[str, int]:
    return {path.name: path.stat().st_size for path in namespace.at(shared.PLACE).iterdir()}


def said(told: subprocess.CompletedProcess[str]) -> str:
    text = told.stdout + told.stderr
    assert "Traceback" not in text
    return text


# --- shared memory ------------------------------------------------------------------------------------


@pytest.mark.sim
def test_a_robot_without_room_for_its_frames_says_by_how_much_and_works(shell: Shell) -> None:
    with inside(shell, {shared.PLACE: "size=16m"}) as namespace:
        profile = small(shell)
        why = "16.8 MB free, 26.5 MB are needed (9.7 MB more): make room, or mount it larger"
        (told,) = (line for line in said(shell("doctor", profile)).splitlines() if "shared memory" in line)
        assert told.startswith("note  shared memory")
        assert f"{shared.PLACE} has {why}" in told
        up = shell("up", profile, "--detach")
        assert up.returncode == exits.DONE, said(up)
        assert f"no shared memory: {shared.PLACE} has {why}; {shared.COSTS}" in said(up).splitlines()
        assert sum(segments(namespace).values()) == shared.SESSION_BYTES
        status = shell("status")
        assert (status.returncode, said(status).count("kinect/frame: no shared memory")) == (exits.DONE, 1)
        assert "kinect/frame" in said(shell("hz", "kinect/frame", "--once"))
        log = shell.run_dir.log("sim").read_text()
        assert log.count("no shared memory") == 1
        assert shell("down").returncode == exits.DONE
        assert segments(namespace) == {}


@pytest.mark.sim
def test_shared_memory_that_fills_keeps_no_command_out_and_costs_no_frame(shell: Shell) -> None:
    with inside(shell, {shared.PLACE: "size=64m"}) as namespace:
        assert shell("up", small(shell), "--detach").returncode == exits.DONE
        taken = segments(namespace)
        assert sum(taken.values()) == shared.need_bytes(publishers=1, readers=0)
        filler = namespace.fill(shared.PLACE)
        for command in (("status",), ("top", "--once"), ("echo", "base/state", "--count", "1")):
            told = shell(*command)
            assert told.returncode == exits.DONE, said(told)
            assert "shared memory" not in said(told)
        hz = shell("hz", "kinect/frame", "--once")
        assert hz.returncode == exits.DONE, said(hz)
        assert said(hz).count("no shared memory") == 1
        filler.unlink()
        assert segments(namespace) == taken
        assert shell("down").returncode == exits.DONE
        assert segments(namespace) == {}


@pytest.mark.sim
def test_what_a_robot_leaves_that_was_killed_altogether_is_gone_at_the_next_up(shell: Shell) -> None:
    with inside(shell, {shared.PLACE: "size=64m"}) as namespace:
        profile = small(shell)
        assert shell("up", profile, "--detach").returncode == exits.DONE
        supervisor = shell.run_dir.supervisor()
        assert supervisor is not None
        for pid in {supervisor.pid, *(by.pid for by in shell.run_dir.claims().values())}:
            os.kill(pid, signal.SIGKILL)
        left = set(segments(namespace))
        assert len(left) == 3
        assert shell("up", profile, "--detach").returncode == exits.DONE
        assert not left & set(segments(namespace))
        assert shell("down").returncode == exits.DONE
        assert segments(namespace) == {}


# --- the run directory --------------------------------------------------------------------------------


def test_a_run_directory_that_fills_stops_no_robot_and_keeps_no_command_out(shell: Shell) -> None:
    with inside(shell, {shell.root: "size=1m,mode=0700"}) as namespace:
        running = shell.start("up", shell.profile("good"))
        running.until("robbie is up")
        filler = namespace.fill(shell.root)
        for command in (("status",), ("top", "--once"), ("topics",)):
            told = shell(*command)
            assert told.returncode == exits.DONE, said(told)
        claim = namespace.at(shell.run_dir.path / "claims" / "good")
        for _ in range(2):  # it is started again all the same, as often as it dies
            os.kill(json.loads(claim.read_text())["pid"], signal.SIGKILL)
            running.until("good was killed by SIGKILL")
            running.until("good ready in")
            assert shell("status").returncode == exits.DONE
        filler.unlink()
        assert shell("down").returncode == exits.DONE
        assert running.end() == exits.DONE
        assert not any("Traceback" in line for line in running.lines)


@pytest.mark.parametrize("detach", [(), ("--detach",)])
def test_a_robot_is_not_started_where_its_run_directory_is_full(shell: Shell, detach: tuple[str, ...]) -> None:
    with inside(shell, {shell.root: "size=64k,mode=0700"}) as namespace:
        namespace.fill(shell.root)
        told = shell("up", shell.profile("good"), *detach)
        assert told.returncode == exits.USAGE
        assert said(told).splitlines() == [
            f"run directory {shell.run_dir.path}/supervisor: No space left on device; make room there, "
            "or choose another by COCORO_RUN_DIR"
        ]
        run = shell("run", "good", "--profile", shell.profile("good"))
        assert run.returncode == exits.USAGE
        assert (
            said(run)
            .splitlines()[-1]
            .endswith(
                f"run directory {shell.run_dir.path}/claims/good: No space left on device; make room there, "
                "or choose another by COCORO_RUN_DIR"
            )
        )


def test_a_run_directory_without_inodes_takes_commands_and_no_services(shell: Shell) -> None:
    with inside(shell, {shell.root: "size=1m,mode=0700,nr_inodes=64"}) as namespace:
        running = shell.start("up", shell.profile("good"))
        running.until("robbie is up")
        filler = namespace.at(shell.root) / "many"
        filler.mkdir()
        try:
            for number in range(64):
                (filler / str(number)).touch()
        except OSError:
            pass
        status = shell("status")
        assert status.returncode == exits.DONE, said(status)
        assert "good     ready" in said(status), "the supervisor tells it, which is in the mesh"
        top = shell("top", "--once")
        assert top.returncode == exits.DONE, said(top)
        assert "No space left on device" in said(top), "a command that joins does so as a visitor"
        run = shell("run", "once", "--profile", shell.profile("good", "once"))
        assert run.returncode == exits.USAGE
        assert said(run).splitlines()[-1].endswith("make room there, or choose another by COCORO_RUN_DIR")
        for path in filler.iterdir():
            path.unlink()
        assert shell("down").returncode == exits.DONE
        assert running.end() == exits.DONE
