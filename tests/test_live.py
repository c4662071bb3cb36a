"""The robot as an operator has it: processes on zenoh, started, used, stopped and gone, by the command alone."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import operator_shell
import psutil
import pytest
from operator_shell import Shell

from apps.cli import exits
from deploy.processes import hardware, stoppable
from deploy.rundir import RunDir

pytestmark = [pytest.mark.zenoh, pytest.mark.sim, pytest.mark.process]

UNDER_WAY_S = 0.1
"""Allowance for messages under way on a busy machine, plus one period of the true state, s."""


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Shell]:
    monkeypatch.setattr(operator_shell, "PATIENCE_S", 300.0)  # a busy machine simulates slowly
    with Shell(tmp_path) as shell:
        shell.run_dir = RunDir("calliope", shell.root)
        yield shell


def runs(pid: int) -> bool:
    """Whether there is a process of that number that is not merely waiting for its parent to notice its end."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_a_robot_is_started_used_stopped_and_leaves_nothing_behind(shell: Shell) -> None:
    up = shell("up", "sim", "--detach", "--frames", "320x240@15")
    assert up.returncode == exits.DONE, up.stdout + up.stderr
    claims = shell.run_dir.claims()
    assert set(claims) >= {*hardware(), "perception", "planning", "executive"}
    supervisor = shell.run_dir.supervisor()
    assert supervisor is not None
    pids = {holder.pid for holder in (*claims.values(), supervisor)}

    park = shell("park", "--json")  # tests/test_readme.py fetches
    assert park.returncode == exits.DONE, park.stdout + park.stderr
    result = json.loads(park.stdout)
    assert (result["outcome"], result["task"]) == ("done", "park")
    assert [phase["name"] for phase in result["phases"]] == ["park"]

    estop = shell("estop", "--json", "--robot", "calliope")
    assert estop.returncode == exits.DONE, estop.stderr
    stopped = json.loads(estop.stdout)
    assert set(stopped["acknowledged"]) >= {*stoppable(), "executive"}
    print(f"from Enter to all halted: {stopped['seconds']:.2f} s")
    refused = shell("put-down")
    assert refused.returncode == exits.REFUSED
    assert "cocoro reset" in refused.stderr
    assert shell("reset").returncode == exits.DONE

    again = shell("park")
    assert again.returncode == exits.DONE, again.stdout + again.stderr
    assert shell("fetch", "teapot").returncode == exits.USAGE

    down = shell("down")
    assert down.returncode == exits.DONE, down.stderr
    assert not shell.run_dir.claims()
    assert not any(map(runs, pids))
    gone = shell("fetch", "red_can")
    assert gone.returncode == exits.NO_MESH
    assert "cocoro up" in gone.stderr
