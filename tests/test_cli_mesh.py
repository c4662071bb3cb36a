"""The commands that look at a robot or stop it, against small services on a zenoh mesh."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from apps.cli import estop_mesh, exits, objects, safety, snapshot, status
from apps.cli.asked import Asked
from apps.cli.link import joined
from apps.cli.options import RobotChoice
from apps.cli.stop_result import StopResult
from apps.client import seeing
from cocoro.bus.endpoints import default
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import RealClock
from cocoro.errors import ConfigError
from cocoro.latch import ServiceLatch
from cocoro.messages import (
    BaseState,
    CancelRequest,
    Detection,
    Detections,
    EstopReply,
    EstopRequest,
    Frame,
    KnownObject,
    Latch,
    ObjectsReply,
    ObjectsRequest,
    PlannerStatus,
    ResetRequest,
    TaskReply,
    TaskRequest,
    TaskState,
)
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import BASE_STATE, CANCEL, DETECTIONS, ESTOP, FRAME, LATCH, OBJECTS, PLAN, RESET, RUN, TASK
from deploy import survey
from deploy.processes import stoppable
from deploy.rundir import RunDir

pytestmark = pytest.mark.zenoh

ANY = RobotChoice()


class FakeRobot:
    """Services in one process, on the mesh of the robot's run directory."""

    def __init__(self, nodes: dict[str, Node], latched_by: dict[str, ServiceLatch]) -> None:
        self.nodes = nodes
        self.latched_by = latched_by

    @property
    def latches(self) -> set[str]:
        return {latch.state for latch in self.latched_by.values()}


@asynccontextmanager
async def robot(*services: str, without_latch: tuple[str, ...] = ()) -> AsyncIterator[FakeRobot]:
    async with AsyncExitStack() as stack:
        bus = await stack.enter_async_context(await ZenohBus.open(default("calliope", "robot")))
        clock, description = RealClock(), Robot.load()
        nodes = {name: Node(name, bus, clock, description, health_hz=20.0) for name in services}
        for node in nodes.values():
            await stack.enter_async_context(node)
        keeping = [name for name in stoppable() if name in nodes and name not in without_latch]
        latches = {name: ServiceLatch(nodes[name], lambda *_: None) for name in keeping}
        for node in nodes.values():
            node.ready("all is well")
        yield FakeRobot(nodes, latches)


def answering(node: Node, latch: str, text: str = "") -> None:
    """Serve the emergency stop with a fixed answer."""

    async def answer(request: EstopRequest | ResetRequest) -> EstopReply:
        return EstopReply(service=node.name, latch=latch, text=text)  # type: ignore[arg-type]

    node.serve(ESTOP.of(node.name), answer)
    node.serve(RESET.of(node.name), answer)


async def stop() -> StopResult:
    run_dir = RunDir("calliope")
    return await estop_mesh.stop(run_dir, run_dir.join_as("operator"), time.monotonic())


def test_an_emergency_stop_latches_all_that_moves(root: Path) -> None:
    async def scenario() -> None:
        async with robot("base", "arm", "hand", "perception") as calliope:
            result = await stop()
            assert calliope.latches == {"latched"}
        assert set(result.acknowledged) == {"base", "arm", "hand"}
        assert (result.missing, result.absent, result.code) == ((), (), exits.DONE)

    asyncio.run(scenario())


def test_one_that_does_not_acknowledge_is_named_and_asked_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estop_mesh, "GIVE_UP_S", 0.5)

    async def scenario() -> None:
        async with robot("base", "arm", "hand", without_latch=("hand",)) as calliope:
            answering(calliope.nodes["hand"], "released")
            result = await stop()
        assert (result.missing, result.code) == (("hand",), exits.FAILED)
        assert "NOT ACKNOWLEDGED by hand" in str(result)

    asyncio.run(scenario())


def test_one_that_is_held_by_a_process_but_is_not_on_the_mesh_counts_as_not_stopped(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estop_mesh, "GIVE_UP_S", 0.2)

    async def scenario() -> None:
        held = RunDir("calliope").claim("base", ["base"])
        async with robot("arm"):
            result = await stop()
        assert (result.missing, result.absent, result.code) == (("base",), ("hand",), exits.FAILED)
        for claim in held:
            claim.release()

    asyncio.run(scenario())


def test_a_mesh_on_which_nothing_moves_is_no_mesh_to_stop(root: Path) -> None:
    async def scenario() -> None:
        async with robot("perception"):
            assert (await stop()).code == exits.NO_MESH

    asyncio.run(scenario())


def test_reset_releases_what_was_stopped(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    async def scenario() -> None:
        async with robot("base", "arm", "hand", "executive") as calliope:
            answering(calliope.nodes["executive"], "released")
            await stop()
            assert await safety.release(ANY) == exits.DONE
            assert calliope.latches == {"released"}

    asyncio.run(scenario())
    assert capsys.readouterr().out == "calliope: released arm, base, hand\n"


def test_when_the_executive_refuses_a_reset_everything_stays_latched(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async def scenario() -> None:
        async with robot("base", "arm", "hand", "executive") as calliope:
            answering(calliope.nodes["executive"], "latched", "a servo is overloaded")
            await stop()
            assert await safety.release(ANY) == exits.REFUSED
            assert calliope.latches == {"latched"}

    asyncio.run(scenario())
    assert "executive does not release the emergency stop: a servo is overloaded" in capsys.readouterr().err


async def _tell(calliope: FakeRobot) -> None:
    nodes = calliope.nodes
    async for _ in nodes["base"].every(50.0):
        nodes["base"].publish(
            BASE_STATE, BaseState(odometry_m=(0, 0), odometry_yaw_rad=0, speed_mps=0, turn_rate_radps=0)
        )
        nodes["executive"].publish(LATCH, Latch(state="released", by="operator"))
        nodes["planning"].publish(PLAN, PlannerStatus(behaviour="approach", why="red_can is 1.2 m away"))
        nodes["executive"].publish(
            TASK, TaskState(task_id="1", task="fetch", label="red_can", phase="approach", elapsed_s=3.0)
        )


def test_status_tells_of_services_task_and_plan(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_dir = RunDir("calliope")
    run_dir.make()
    profile = {"name": "robot", "robot": "calliope", "processes": ["base", "planning", "executive", "perception"]}
    run_dir.profile_file.write_text(json.dumps(profile))

    async def scenario(as_json: bool) -> int:
        async with robot("base", "planning", "executive") as calliope:
            calliope.nodes["base"].spawn(_tell(calliope))
            return await status.show_status(ANY, as_json)

    assert asyncio.run(scenario(as_json=False)) == exits.FAILED  # perception should run, and does not
    text = capsys.readouterr().out
    for line in (
        "calliope (profile robot)",
        "approach: red_can is 1.2 m away",
        "fetch red_can, approach, 3.0 s",
        "released by operator",
    ):
        assert line in text
    assert [line.split()[:2] for line in text.splitlines() if "all is well" in line or "as base" in line] == [
        ["base", "ready"], ["planning", "ready"], ["executive", "ready"],
    ], "they are one process"  # fmt: skip
    assert "perception  not alive" in text

    asyncio.run(scenario(as_json=True))
    report = json.loads(capsys.readouterr().out)
    assert {service["service"]: service["alive"] for service in report["services"]} == {
        "base": True, "planning": True, "executive": True, "perception": False,
    }  # fmt: skip
    assert report["plan"]["behaviour"] == "approach"


def test_the_supervisor_tells_what_the_command_would_find(root: Path) -> None:
    run_dir = RunDir("calliope")
    run_dir.make()

    async def scenario() -> None:
        async with (
            robot("base", "planning", "executive") as calliope,
            await ZenohBus.open(run_dir.join_as("supervisor")) as bus,
            joined(ANY) as link,
        ):
            calliope.nodes["base"].spawn(_tell(calliope))
            server = survey.SurveyServer(survey.Onlooker(run_dir, bus))
            await server.open()
            found = await survey.Survey(link).take(set(await link.alive()))
            told = await asyncio.to_thread(status.told_by_supervisor, Asked(run_dir.survey_socket))
            assert told is not None
            assert told.keys() == found.keys()
            for known in (told, found):
                assert {one["service"]: one["state"] for one in known["services"]} == dict.fromkeys(
                    ("base", "executive", "planning"), "ready"
                )
                assert (known["task"]["phase"], known["latch"]["by"]) == ("approach", "operator")
                assert (known["plan"]["behaviour"], known["recording"]) == ("approach", None)
                assert known["base"]["charging"] is False
            server.close()
            assert not run_dir.survey_socket.exists()
            assert await asyncio.to_thread(status.told_by_supervisor, Asked(run_dir.survey_socket)) is None

    asyncio.run(scenario())


@pytest.mark.parametrize("answer", [b"", b"{", b"[]"])
def test_a_supervisor_that_tells_no_report_is_no_answer(root: Path, answer: bytes) -> None:
    run_dir = RunDir("calliope")
    run_dir.make()

    async def say(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(answer)
        writer.close()

    async def scenario() -> None:
        async with await asyncio.start_unix_server(say, run_dir.survey_socket):
            assert await asyncio.to_thread(status.told_by_supervisor, Asked(run_dir.survey_socket)) is None

    asyncio.run(scenario())


def test_the_state_of_a_replayed_service_has_one_name() -> None:
    assert status.REPLAYED == survey.REPLAYED


def test_objects_are_listed_with_where_they_were_seen(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    async def answer(request: ObjectsRequest) -> ObjectsReply:
        can = KnownObject(label="red_can", shape="cylinder", size_m=(0.066, 0.066, 0.12), graspable=True)
        return ObjectsReply(objects=(can,))

    async def scenario(as_json: bool) -> int:
        async with robot("executive") as calliope:
            calliope.nodes["executive"].serve(OBJECTS, answer)
            return await objects.list_objects(ANY, as_json)

    assert asyncio.run(scenario(as_json=False)) == exits.DONE
    assert capsys.readouterr().out.splitlines()[1] == "red_can  cylinder  6.6 x 6.6 x 12.0  yes        -"
    assert asyncio.run(scenario(as_json=True)) == exits.DONE
    assert json.loads(capsys.readouterr().out)[0]["label"] == "red_can"


async def see(calliope: FakeRobot, detect: bool) -> None:
    """Publish frames, each a little brighter, and what is seen in each some frames later."""
    camera = calliope.nodes["kinect"]
    sent: list[Frame] = []
    async for _ in camera.every(50.0):
        colour = np.full((48, 64, 3), len(sent) % 200, np.uint8)
        frame = Frame(width=64, height=48, colour=memoryview(colour.tobytes()), depth=memoryview(bytes(2 * 48 * 64)))
        sent.append(camera.publish(FRAME, frame))
        if detect and len(sent) > 3:
            seen = sent[-3]
            can = Detection(label="red_can", u_px=30, v_px=20, area_px=100, box_px=(20, 10, 40, 30))
            calliope.nodes["perception"].publish(
                DETECTIONS,
                Detections(
                    frame_seq=seen.seq, frame_incarnation=seen.incarnation, width=64, height=48, detections=(can,)
                ),
            )


@pytest.mark.parametrize(
    ("detect", "words"),
    [(True, "64 x 48, red_can"), (False, "64 x 48, without detections (none came from perception)")],
)
def test_a_snapshot_is_a_frame_with_what_was_detected_in_that_frame(
    root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    detect: bool,
    words: str,
) -> None:
    monkeypatch.setattr(seeing, "DETECTIONS_S", 1.0 if not detect else 30.0)
    out = tmp_path / "out" / "seen.png"

    async def scenario() -> None:
        async with robot("kinect", "perception") as calliope:
            calliope.nodes["kinect"].spawn(see(calliope, detect))
            assert await snapshot.take_snapshot(ANY, out) == exits.DONE

    asyncio.run(scenario())
    assert capsys.readouterr().out == f"{out}: {words}\n"
    assert out.read_bytes().startswith(b"\x89PNG")


@pytest.mark.process
def test_ctrl_c_on_a_running_fetch_cancels_the_task_on_the_robot(root: Path) -> None:
    cancelled: list[str] = []

    async def scenario() -> None:
        async with robot("executive") as calliope:
            node = calliope.nodes["executive"]

            async def run(request: TaskRequest) -> TaskReply:
                node.spawn(tell())
                return TaskReply(accepted=True, task_id="fetch-1")

            async def tell() -> None:
                async for _ in node.every(20.0):
                    outcome: Literal["cancelled"] | None = "cancelled" if cancelled else None
                    node.publish(TASK, TaskState(task_id="fetch-1", phase="approach", outcome=outcome, elapsed_s=1.0))

            async def cancel(request: CancelRequest) -> TaskReply:
                cancelled.append(request.task_id)
                return TaskReply(accepted=True, task_id=request.task_id)

            node.serve(RUN, run)
            node.serve(CANCEL, cancel)
            fetch = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "apps.cli.main", "fetch", "red_can", stdout=asyncio.subprocess.PIPE
            )
            assert fetch.stdout is not None
            assert b"approach" in await fetch.stdout.readline()
            fetch.send_signal(signal.SIGINT)
            rest = (await fetch.stdout.read()).decode().splitlines()
            assert await fetch.wait() == exits.REFUSED
        assert cancelled == ["fetch-1"]
        assert rest[-1] == "cancelled: fetch red_can after 1.0 s"

    asyncio.run(scenario())


def test_of_several_robots_one_must_be_named(root: Path) -> None:
    async def scenario() -> None:
        async with robot("executive"), await ZenohBus.open(default("robbie", "robot")):
            with pytest.raises(ConfigError, match=r"--robot calliope, --robot robbie"):
                await status.show_status(ANY, as_json=False)

    asyncio.run(scenario())
