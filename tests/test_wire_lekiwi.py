"""Profile lekiwi-wire as processes: one service drives arm, hand and wheels of a LeKiwi over one emulated wire."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from operator_shell import Shell

from deploy.rundir import RunDir

FAULT_S = 30.0
"""Longest wait until a fault is shown."""
LEFT = 7
VOLTAGE = 62
NEAR = """
[[object]]
label = "red_can"
shape = "cylinder"
radius_m = 0.033
height_m = 0.12
position_m = [0.8, 0.1]
"""
pytestmark = [pytest.mark.zenoh, pytest.mark.sim, pytest.mark.process]


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    with Shell(tmp_path) as shell:
        shell.run_dir = RunDir("lekiwi", shell.root)
        yield shell


def ask(shell: Shell, **question: object) -> dict[str, dict[str, int]]:
    """The state of the emulated hardware."""
    with socket.socket(socket.AF_UNIX) as control:
        control.connect(str(shell.run_dir.path / "wire" / "control"))
        control.sendall(json.dumps(question).encode() + b"\n")
        answer = json.loads(control.makefile().readline())
    assert "error" not in answer, answer
    ok: dict[str, dict[str, int]] = answer["ok"]
    return ok


def told(shell: Shell, text: str, *command: str) -> str:
    """What a command says, as soon as the text is in it."""
    end_s = time.monotonic() + FAULT_S
    while text not in (said := shell(*command).stdout) and time.monotonic() < end_s:
        pass
    assert text in said
    return said


def test_a_lekiwi_behind_its_wire_parks_goes_to_a_can_stops_and_tells_of_a_dead_wheel(
    shell: Shell, tmp_path: Path
) -> None:
    scene = tmp_path / "near.toml"
    scene.write_text(NEAR)
    up = shell("up", "lekiwi-wire", "--detach", "--no-cockpit", "--frames", "160x120@10", "--scene", str(scene))
    assert up.returncode == 0, up.stdout + up.stderr
    for task in (("park",), ("go-to", "red_can")):
        done = shell(*task, "--json")
        assert done.returncode == 0, done.stdout + done.stderr
        assert json.loads(done.stdout)["outcome"] == "done"
    odometry = shell("base").stdout
    assert "stopped    no" in odometry or "stopped    by no command" in odometry
    assert set(ask(shell, do="look")["wheels"].values()) == {0}

    stopped = shell("stop", "--robot", "lekiwi")  # other robots of this machine are not its own
    assert stopped.returncode == 0, stopped.stdout + stopped.stderr
    assert "wheels" in stopped.stdout, "the guard has an address of its own"
    assert "estop" in shell("base").stdout
    assert shell("reset").returncode == 0

    ask(shell, do="put", servo=LEFT, address=VOLTAGE, value=0)
    told(shell, f"wheel left (ID {LEFT}) does not answer", "status")
    refused = shell("base", "recover")
    assert refused.returncode == 3
    assert "does not answer" in refused.stderr
    ask(shell, do="put", servo=LEFT, address=VOLTAGE, value=120)
    ask(shell, do="restart", servo=LEFT)
    told(shell, "wheel left lost its settings a moment ago", "base")
    assert shell("base", "recover").returncode == 0
    assert shell("down").returncode == 0
