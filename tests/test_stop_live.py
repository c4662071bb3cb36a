"""The emergency stop of a robot that drives, process by process: among hostile neighbours, and over restarts."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from namespace_rig import no_namespaces
from operator_shell import Shell

from apps.cli import exits
from bench.report import decode
from bench.stop import BY_ITSELF, SITUATIONS, TRUE, groups
from cocoro.stop.record import latch_dir, read
from deploy.rundir import RunDir

pytestmark = [pytest.mark.zenoh, pytest.mark.sim, pytest.mark.process]

ROOT = Path(__file__).parents[1]
SMALL = ("--frames", "160x120@10")
PROCESSES = {
    "sim": ["sim", "perception", "planning", "executive"],
    "sim-wire": ["wire", "base", "servos", "perception", "planning", "executive"],
}
"""Those of each profile but the recorder, which has no part in a stop."""


needs_namespaces = pytest.mark.skipif(bool(no_namespaces()), reason=f"no namespaces: {no_namespaces()}")


class Bench:
    """Runs `python -m bench stop` once for all situations that one robot can meet one after the other."""

    def __init__(self) -> None:
        self._ran: dict[str, subprocess.CompletedProcess[str]] = {}

    def __call__(self, situation: str) -> subprocess.CompletedProcess[str]:
        if situation not in self._ran:
            (group,) = (group for group in groups(SITUATIONS) if situation in group)
            options = ("--count", "2", "--any-time", "--one-robot", "--json")
            command = [sys.executable, "-m", "bench", "stop", *group, *options]
            self._ran |= dict.fromkeys(group, subprocess.run(command, cwd=ROOT, capture_output=True, text=True))
        return self._ran[situation]


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench()


SITUATION = [
    pytest.param(situation, marks=[] if situation in BY_ITSELF else [pytest.mark.alone]) for situation in SITUATIONS
]
"""No time is judged; but those that one robot meets burden the whole machine, and would disturb tests beside them."""


@needs_namespaces
@pytest.mark.parametrize("situation", SITUATION)
def test_a_robot_at_full_speed_is_stopped_whatever_its_neighbours_do(situation: str, bench: Bench) -> None:
    done = bench(situation)
    assert done.returncode == 0, done.stdout + done.stderr
    stops = {figure.name: figure for figure in decode(done.stdout.encode(), "the bench's output").figures}
    good = stops[f"{situation}: {TRUE}"]
    assert (good.count, good.median) == (2, 100.0), done.stdout


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    """Commands for a robot of a name that no other robot of this machine has."""
    with Shell(tmp_path) as shell:
        shell.run_dir = RunDir(f"robot-{os.urandom(4).hex()}", shell.root)
        yield shell


def up(shell: Shell, *options: str, profile: str = "sim") -> str:
    settings = (f'robot="{shell.run_dir.robot}"', f"processes={json.dumps(PROCESSES[profile])}")
    sets = [word for setting in settings for word in ("--set", setting)]
    done = shell("up", profile, "--detach", *SMALL, *sets, *options)
    assert done.returncode == exits.DONE, done.stdout + done.stderr
    return done.stdout


def latch(shell: Shell) -> str:
    """The latch in the status, once the executive knows it."""
    for _ in range(100):
        done = shell("status", "--json", "--robot", shell.run_dir.robot)
        told = json.loads(done.stdout)
        if (told.get("latch") or {}).get("state") not in (None, "unknown"):
            return str(told["latch"]["state"])
    raise AssertionError(done.stdout + done.stderr)


def robot(shell: Shell, *arguments: str) -> subprocess.CompletedProcess[str]:
    return shell(*arguments, "--robot", shell.run_dir.robot)


def kill(shell: Shell, *services: str) -> None:
    """Kill services as simultaneously as possible."""
    targets = [shell.target(service) for service in services]
    for target in targets:
        target.signal(signal.SIGKILL)
    for target in targets:
        target.wait(60.0)
        target.close()


@pytest.mark.parametrize("profile", ["sim", "sim-wire"])
def test_the_latch_outlives_the_death_of_everything_and_only_a_reset_releases_it(shell: Shell, profile: str) -> None:
    assert "stopped" not in up(shell, profile=profile)
    assert latch(shell) == "released"
    stopped = robot(shell, "stop", "--json")
    assert stopped.returncode == exits.DONE, stopped.stdout + stopped.stderr
    told = json.loads(stopped.stdout)
    moves = {"base", "arm", "hand"} | ({"wheels"} if profile == "sim-wire" else set())
    assert (set(told["latched_ns"]) >= moves, told["missing"], told["not_kept"]) == (True, [], [])

    supervisor = shell.run_dir.supervisor()
    assert supervisor is not None
    os.kill(supervisor.pid, signal.SIGKILL)
    kill(shell, "executive", "base", "arm")
    said = up(shell, profile=profile)
    assert "the emergency stop is latched by operator (user " in said
    assert "`cocoro reset` releases it" in said
    assert latch(shell) == "latched"
    assert robot(shell, "fetch", "red_can").returncode == exits.REFUSED

    kill(shell, "executive", "base")  # simultaneously; the supervisor restarts them
    assert latch(shell) == "latched"
    for _ in range(20):
        if (reset := robot(shell, "reset")).returncode == exits.DONE:
            break
    assert reset.returncode == exits.DONE, reset.stderr
    assert latch(shell) == "released"
    assert robot(shell, "down").returncode == exits.DONE
    assert "stopped" not in up(shell, profile=profile)
    assert latch(shell) == "released", "what was reset stays so"


def test_a_first_start_that_nobody_watches_and_one_after_damage_to_a_record_come_up_stopped(shell: Shell) -> None:
    said = up(shell, "--unattended")
    assert "the emergency stop is latched by a first start without a person" in said
    assert latch(shell) == "latched"
    assert robot(shell, "reset").returncode == exits.DONE
    assert latch(shell) == "released"

    assert robot(shell, "down").returncode == exits.DONE
    record = latch_dir(shell.run_dir.robot) / "arm"
    record.write_bytes(b"?" * 512)
    assert "which cannot be read: it is damaged" in up(shell)
    assert latch(shell) == "latched"
    assert robot(shell, "reset").returncode == exits.DONE
    assert not read(record).latched


def test_a_latch_that_cannot_be_kept_or_read_comes_up_stopped_and_says_why(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = shell.folder / "blocked"
    blocked.write_text("a file where a folder should be")
    monkeypatch.setenv("COCORO_STATE_DIR", str(blocked))
    said = up(shell)
    assert f"the emergency stop's latch cannot be kept in {blocked}" in said
    assert latch(shell) == "latched"
    reset = robot(shell, "reset")
    assert reset.returncode == exits.DONE
    assert "a restart will forget this" in reset.stdout + reset.stderr
    stopped = robot(shell, "stop")
    assert "A RESTART WILL FORGET IT" in stopped.stdout + stopped.stderr
