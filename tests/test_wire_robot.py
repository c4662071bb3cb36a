"""Profile sim-wire as processes: the real base and servo services fetch the can over emulated wires."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from operator_shell import Shell

from deploy.rundir import RunDir

FAULT_S = 20.0
"""Longest wait until a fault is shown."""
pytestmark = [pytest.mark.zenoh, pytest.mark.sim, pytest.mark.process]


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    with Shell(tmp_path) as shell:
        shell.run_dir = RunDir("calliope", shell.root)
        yield shell


def ask(shell: Shell, **question: object) -> object:
    """The state of the emulated hardware."""
    with socket.socket(socket.AF_UNIX) as control:
        control.connect(str(shell.run_dir.path / "wire" / "control"))
        control.sendall(json.dumps(question).encode() + b"\n")
        answer = json.loads(control.makefile().readline())
    assert "error" not in answer, answer
    return answer["ok"]


def test_the_robot_behind_wires_comes_up_parks_and_tells_of_a_fault(shell: Shell) -> None:
    up = shell("up", "sim-wire", "--detach", "--frames", "160x120@10")
    assert up.returncode == 0, up.stdout + up.stderr
    parked = shell("park", "--json")
    assert parked.returncode == 0, parked.stdout + parked.stderr
    assert json.loads(parked.stdout)["outcome"] == "done"
    ask(shell, do="trip", servo=5)
    ask(shell, do="feel", field="drop_left", value=True)
    servos = ask(shell, do="look")["servos"]  # type: ignore[index]
    assert servos["5"]["torque_limit"] == 0
    told = ""
    end_s = time.monotonic() + FAULT_S
    while time.monotonic() < end_s:  # each shows the newest health, which comes once a second
        told = shell("status").stdout
        if "elbow: overload" in told and "fell back" in told:
            break
    assert "elbow: overload" in told
    assert "fell back to passive" in told
    base = shell("base")
    assert base.returncode == 1
    assert "stopped    by mode" in base.stdout
    refused = shell("base", "recover")
    assert refused.returncode == 3
    assert "a wheel hangs in the air" in refused.stderr
    ask(shell, do="feel", field="drop_left", value=False)
    assert shell("base", "recover").returncode == 0
    cleared = shell("servos", "clear", "elbow")
    assert (cleared.returncode, cleared.stdout) == (0, "arm: cleared: elbow\n"), cleared.stderr
    assert "sensors    nothing" in shell("base").stdout
    assert "another program" in shell("servos", "calibrate", "elbow", "--profile", "sim-wire").stderr
    assert shell("down").returncode == 0
    assert not (shell.run_dir.path / "wire" / "control").exists()
