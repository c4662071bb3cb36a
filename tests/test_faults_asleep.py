"""All processes of a robot are stopped together, as by a laptop's lid, and continue: no living one is called dead."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from pathlib import Path

import pytest
from faults_live import PROCESSES, SHORT_LEASE, LiveRobot, live
from operator_shell import Running
from test_faults_live import FAR

pytestmark = [pytest.mark.zenoh, pytest.mark.sim, pytest.mark.process]

ASLEEP_S = 4.0
SAID = "this machine was asleep or starved for"


@pytest.fixture
def far(tmp_path: Path) -> Path:
    scene = tmp_path / "far.toml"
    scene.write_text(FAR)
    return scene


def everyone(robot: LiveRobot, *others: Running) -> set[int]:
    """The processes of the robot, its supervisor, and an operator's."""
    return {by.pid for by in robot.run_dir.claims().values()} | {each.process.pid for each in (robot.up, *others)}


def said_by_all(robot: LiveRobot, *others: Running) -> str:
    """All output on terminals and in logs; the supervisor's log contains its whole output."""
    logs = [robot.run_dir.log(process).read_text() for process in (*PROCESSES, "supervisor")]
    return "\n".join([*logs, *(line for each in others for line in each.lines)])


def test_when_all_sleep_for_longer_than_the_lease_the_robot_stands_and_nobody_is_called_dead(
    tmp_path: Path, far: Path
) -> None:
    async def scenario() -> None:
        async with live(tmp_path, scene=far, mesh=SHORT_LEASE) as robot:
            fetch = Running([sys.executable, "-m", "apps.cli.main", "fetch", "red_can"], robot.env)
            try:
                await robot.drives()
                processes = everyone(robot, fetch)
                pids = {service: by.pid for service, by in robot.run_dir.claims().items()}
                for pid in processes:
                    os.kill(pid, signal.SIGSTOP)
                await asyncio.sleep(ASLEEP_S)
                for pid in processes:
                    os.kill(pid, signal.SIGCONT)
                awake = await robot.told(SAID)
                assert float(awake.partition(SAID)[2].split()[0]) >= ASLEEP_S - 1.0
                code = await asyncio.to_thread(fetch.end)
                if code != 0:  # a connection broke: the task has ended, and the robot stands
                    assert code in (1, 3)
                    ended_s = robot.now_s
                    await robot.passes(0.5)
                    assert robot.stood_since(ended_s)
                    whys = (SAID, "nothing from the planner", "asker_gone", "looking again")
                    assert any(why in line for why in whys for line in fetch.lines), fetch.lines
                said = said_by_all(robot, fetch)
                assert " died" not in said
                assert said.count("no sign of it") == said.count("is back") == 0, said
                code, answer = await robot.command("park")
                if code == 3 and "the hand holds something" in answer:  # the fetch went on to its end, or nearly so
                    code, answer = await robot.command("put-down")
                assert code == 0, answer
                assert {service: by.pid for service, by in robot.run_dir.claims().items()} == pids
            finally:
                fetch.process.kill()
                fetch.process.wait()

    asyncio.run(scenario())
