"""Programs that operate a live simulated robot: with asyncio, without, from a notebook, and when they are killed."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from faults_live import PROCESSES, LiveRobot, live
from operator_shell import PATIENCE_S

import cocoro
import cocoro.topics
from apps.client.handle import TaskHandle
from cocoro.errors import CocoroError, MeshError
from cocoro.messages import TaskState

pytestmark = [pytest.mark.zenoh, pytest.mark.process, pytest.mark.sim]

ROOT = Path(__file__).parent.parent
NOTEBOOK = ROOT / "docs" / "first_steps.ipynb"
NAME = "client"
"""A name of its own: the stop path stops all robots of a name on this machine."""
DRIVES = """
import cocoro
with cocoro.connect_blocking("client") as robot:
    print("connected", flush=True)
    try:
        robot.fetch("red_can")
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


async def takes_tasks(robot: LiveRobot) -> None:
    """Wait until the robot takes a task."""
    async with cocoro.connect(NAME) as client, asyncio.timeout(PATIENCE_S):
        while not (await client.status()).ready:  # noqa: ASYNC110 # each question takes its time
            await asyncio.sleep(0.2)


async def a_program_with_asyncio(robot: LiveRobot) -> None:
    async with cocoro.connect(NAME) as client:
        view = await client.see()
        assert view.colour.shape == (*view.depth_m.shape, 3)
        assert {"red_can"} <= {one.label for one in await client.objects()}
        with pytest.raises(cocoro.UnknownLabelError):
            await client.fetch("teapot")
        task: TaskHandle = client.go_to("red_can")
        await task.accepted()
        await robot.drives()
        stopped = await client.stop()
        assert {"base", "arm", "hand"} <= {*stopped.acknowledged}
        with pytest.raises(cocoro.TaskEndedError) as caught:
            await task
        assert caught.value.reason == "estop"
        with pytest.raises(cocoro.StoppedError):
            await client.park()
        assert (await client.reset()).services == ("arm", "base", "hand")
        async with client.drive() as drive:
            since_s = await robot.surely_now_s()
            await drive.move(cocoro.Motion(turn_radps=0.5), for_s=1.0)
            assert drive.reply.tick
        assert robot.obeyed_since(since_s)
        await client.go_to("red_can").accepted()
        await robot.drives()
    since_s = await robot.surely_now_s()
    await robot.passes(0.5)
    assert robot.stood_since(since_s + 0.2), "the program has left, and its task with it"


def a_program_without_asyncio() -> None:
    with cocoro.connect_blocking(NAME) as client:
        assert client.name == NAME
        assert client.park().task == "park"
        going = client.start({"task": "go-to", "label": "red_can", "distance_m": 0.4})
        with pytest.raises(cocoro.BusyError):
            client.park()
        states = [*going]
        assert (states[-1].outcome, going.done) == ("done", True)
        assert going.result().task_id == going.task_id == client.attend().task_id
        assert next(client.watch("base/state")).seq > 0
        again = client.start({"task": "park"}, detach=True)
        state = again.cancel()
        assert state is None or state.outcome in ("cancelled", "done")
        with client.drive() as drive:
            drive.move(cocoro.Motion(turn_radps=0.3), for_s=0.3)
            assert drive.reply.tick
        with pytest.raises(cocoro.TaskEndedError, match="timed_out"):
            client.go_to("green_can", timeout_s=0.1)
        assert client.see(detections=False).detections is None
    with pytest.raises(CocoroError, match="connect again"):
        client.status()
    client.close()


async def a_program_that_ends_by(robot: LiveRobot, number: signal.Signals) -> str:
    """The reason for which its task was cancelled, when it gets a signal in the middle of it; and its last words."""
    before = {state.task_id for state in robot.heard(cocoro.topics.TASK)}
    robot.forget()
    command = [sys.executable, "-c", DRIVES]
    program = await asyncio.create_subprocess_exec(*command, env=robot.env, cwd=ROOT, stdout=subprocess.PIPE)
    await robot.drives()
    program.send_signal(number)
    said, _ = await program.communicate()
    assert (b"interrupted" in said) == (number is signal.SIGINT)

    def over() -> list[TaskState]:
        return [one for one in robot.heard(cocoro.topics.TASK) if one.outcome and one.task_id not in before]

    await robot.until(over, PATIENCE_S)
    assert over()[-1].outcome == "cancelled"
    return over()[-1].reason.partition(":")[0]


def test_programs_operate_a_live_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def scenario() -> None:
        async with live(tmp_path, name=NAME, pace=1.0, frame_rate_hz=15.0) as robot:
            monkeypatch.setenv("COCORO_RUN_DIR", robot.env["COCORO_RUN_DIR"])
            with pytest.raises(MeshError, match="did you mean client"):
                await cocoro.connect("clinet").__aenter__()
            await takes_tasks(robot)
            await a_program_with_asyncio(robot)
            await asyncio.to_thread(a_program_without_asyncio)
            assert await a_program_that_ends_by(robot, signal.SIGINT) == "by the operator"
            assert await a_program_that_ends_by(robot, signal.SIGKILL) == "asker_gone"
            async with cocoro.connect(NAME) as client:
                task = client.go_to("green_can")
                await task.accepted()
                robot.signal("executive", signal.SIGKILL)
                with pytest.raises(cocoro.TaskLostError) as caught:
                    await task
                assert caught.value.reason == "died"

    asyncio.run(scenario())


def test_without_a_robot_it_is_said_what_to_start(root: Path) -> None:
    with pytest.raises(MeshError, match="cocoro up sim"):
        cocoro.connect_blocking()


def test_the_notebook_runs_from_its_first_cell_to_its_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COCORO_CAPTURE_DIR", str(tmp_path / "captures"))

    async def scenario() -> None:
        async with live(
            tmp_path, name="notebook", processes=("capture", *PROCESSES), pace=1.0, frame_rate_hz=15.0
        ) as robot:
            environment = robot.env | {"MPLBACKEND": "agg", "PYTHONPATH": str(ROOT)}
            command = [sys.executable, str(ROOT / "tests" / "notebook_rig.py"), str(NOTEBOOK)]
            done = await asyncio.to_thread(
                subprocess.run, command, env=environment, capture_output=True, text=True, timeout=900.0, check=False
            )
            assert done.returncode == 0, done.stderr
            shown = [json.loads(line) for line in done.stdout.splitlines()]
            assert shown[0]["value"] == "<notebook>"
            assert "released" in shown[1]["value"]
            assert "end" in shown[2]["value"]
            assert shown[3]["picture"] == b"\x89PNG\r\n\x1a\n"[:8].hex()
            assert "red_can" in shown[4]["printed"]
            assert "lift" in shown[5]["printed"]
            assert "put it down first" in shown[6]["printed"]
            assert "emergency stop" in shown[8]["printed"]
            assert "it drove at up to 0." in shown[9]["printed"]

    asyncio.run(scenario())
