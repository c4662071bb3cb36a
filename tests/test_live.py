"""The robot as an operator has it: processes on zenoh, started, used, stopped and gone, by the command alone."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections.abc import AsyncIterator, Iterator
from math import hypot
from pathlib import Path

import operator_shell
import psutil
import pytest
from operator_shell import Shell

from apps.cli import exits
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import NS, FollowedClock
from cocoro.inbox import Stream
from cocoro.messages import Truth
from cocoro.node import Node
from cocoro.robot import Robot
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


def test_a_planner_that_is_frozen_while_driving_leaves_a_robot_that_stands_and_then_goes_on(shell: Shell) -> None:
    """All times are the simulator's, so load affects only messages under way."""
    patient = ("--set", "mesh.lease_s=60")  # on a busy machine two simulated seconds may be longer than the usual lease
    assert shell("up", "sim", "--detach", "--frames", "320x240@15", *patient).returncode == exits.DONE
    fetch = shell.start("fetch", "red_can")

    async def scenario() -> None:
        async with (
            await ZenohBus.open(shell.run_dir.join_as("watcher")) as bus,
            Node("watcher", bus, FollowedClock(), Robot.load()) as watcher,
        ):
            last_said: list[int] = []
            watcher.on(topics.BASE_COMMAND, lambda message: last_said.append(message.stamp_ns))
            truths = watcher.stream(topics.TRUTH)
            async for speed_mps, _ in speeds(truths):
                if speed_mps > 0.25:
                    break
            os.kill(shell.pid("planning"), signal.SIGSTOP)
            rolling_ns = 0
            async for speed_mps, start_ns in speeds(truths):
                if speed_mps >= 0.01:
                    rolling_ns = start_ns
                if last_said and start_ns - last_said[-1] > 2 * NS:
                    break
            assert rolling_ns - last_said[-1] < (0.30 + UNDER_WAY_S) * NS
            os.kill(shell.pid("planning"), signal.SIGCONT)

    asyncio.run(scenario())
    assert fetch.end() == exits.DONE, fetch.lines


async def speeds(truths: Stream[Truth]) -> AsyncIterator[tuple[float, int]]:
    """The body's true speed between each two truths, and when it began, simulated time."""
    before = await truths.next()
    async for truth in truths:
        passed_ns = truth.stamp_ns - before.stamp_ns
        way_m = hypot(truth.body_m[0] - before.body_m[0], truth.body_m[1] - before.body_m[1])
        yield way_m / passed_ns * NS, before.stamp_ns
        before = truth
