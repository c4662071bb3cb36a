"""What a component is written against, on the bus of one process and in virtual time."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import pytest

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import NS, Clock, VirtualClock
from cocoro.core import Output, Sample, Schedule, Take
from cocoro.errors import CallTimeoutError, ConfigError, MeshError, RemoteError
from cocoro.messages import (
    BaseCommand,
    BaseState,
    CancelRequest,
    Detections,
    EstopReply,
    EstopRequest,
    Intent,
    Message,
    StepRecord,
    TaskReply,
)
from cocoro.node import RECORDER_S, Node
from cocoro.robot import Robot
from cocoro.testing import JumpingClock, Tap, in_virtual_time, settle
from cocoro.topics import Topic

MS = NS // 1000
ROBOT = Robot.load()
HERE: dict[str, Any] = {"odometry_m": (0.0, 0.0), "odometry_yaw_rad": 0.0, "speed_mps": 0.0, "turn_rate_radps": 0.0}


class Mesh:
    """A mesh that nodes of a test join."""

    def __init__(self, clock: Clock | None = None) -> None:
        self.mesh = LocalMesh()
        self.clock = clock or VirtualClock()

    def node(self, name: str, **options: Any) -> Node:
        return Node(name, self.mesh.join(), self.clock, ROBOT, **options)

    def tap(self) -> Tap:
        return Tap(self.mesh.join(), ROBOT.name)


def state(**fields: Any) -> BaseState:
    return BaseState(**(HERE | fields))


def seen(stamp_ns: int = 0) -> Detections:
    return Detections(stamp_ns=stamp_ns, frame_seq=0, frame_incarnation=0, width=1, height=1)


# --- publishing -----------------------------------------------------------------------------------


@in_virtual_time
async def test_what_is_published_says_when_and_in_which_order() -> None:
    mesh = Mesh()
    async with mesh.node("base") as node:
        await asyncio.sleep(2.0)
        first = node.publish(topics.BASE_STATE, state())
        second = node.publish(topics.BASE_STATE, state(), stamp_ns=NS)
        third = node.publish(topics.BASE_STATE, state(stamp_ns=3))
    assert [message.stamp_ns for message in (first, second, third)] == [2 * NS, NS, 3]
    assert [message.seq for message in (first, second, third)] == [0, 1, 2]
    assert first.incarnation == second.incarnation == third.incarnation


@in_virtual_time
async def test_a_restarted_publisher_is_another_incarnation() -> None:
    mesh, incarnations = Mesh(), set()
    for _ in range(3):
        async with mesh.node("base") as node:
            incarnations.add(node.publish(topics.BASE_STATE, state()).incarnation)
    assert len(incarnations) == 3


@in_virtual_time
async def test_a_topic_carries_its_own_type_alone() -> None:
    async with Mesh().node("base") as node:
        with pytest.raises(TypeError, match="base/state carries BaseState, not BaseCommand"):
            node.publish(topics.BASE_STATE, BaseCommand(left_mps=0.0, right_mps=0.0))  # type: ignore[misc]


# --- reading --------------------------------------------------------------------------------------


@in_virtual_time
async def test_all_readers_of_a_topic_in_a_node_get_everything() -> None:
    mesh = Mesh()
    async with mesh.node("base") as base, mesh.node("planning") as reader:
        handled: list[BaseState] = []
        reader.on(topics.BASE_STATE, handled.append)
        latest, stream = reader.latest(topics.BASE_STATE), reader.stream(topics.BASE_STATE)
        for number in range(3):
            base.publish(topics.BASE_STATE, state(speed_mps=number))
        await settle()
        assert [message.speed_mps for message in handled] == [0, 1, 2]
        assert [(await stream.next()).speed_mps for _ in range(3)] == [0, 1, 2]
        assert latest.value is not None
        assert latest.value.speed_mps == 2
        assert len([s for s in mesh.mesh.subscriptions if s.keyexpr == "calliope/base/state"]) == 1


@in_virtual_time
async def test_a_robot_never_hears_another_robot() -> None:
    mesh = Mesh()
    async with mesh.node("base", robot_name="bob") as bobs, mesh.node("planning", robot_name="ada") as adas:
        heard = adas.stream(topics.BASE_STATE)
        everyone = adas.stream(topics.HEALTH, service="*")
        bobs.publish(topics.BASE_STATE, state())
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(heard.next(), 10.0)
        assert {(await everyone.next()).service for _ in range(5)} == {"planning"}
        with pytest.raises(MeshError, match=r"nobody answers ada/base/about"):
            await adas.call(topics.ABOUT.of("base"), msgspec.convert({}, topics.ABOUT.request))


# --- driving a core -------------------------------------------------------------------------------


class Echo:
    """A core that remembers its steps and answers each detection with a command."""

    def __init__(self, rate_hz: float | None = 50.0, triggers: tuple[Topic[Any], ...] = (topics.DETECTIONS,)) -> None:
        self.steps: list[tuple[int, list[tuple[str, int]]]] = []
        self._schedule = Schedule(rate_hz, triggers)
        self.raises: Exception | None = None

    @property
    def reads(self) -> Mapping[Topic[Any], Take]:
        return {topics.DETECTIONS: "all", topics.BASE_STATE: "latest"}

    @property
    def schedule(self) -> Schedule:
        return self._schedule

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        if self.raises is not None:
            raise self.raises
        self.steps.append((now_ns, [(sample.topic.name, sample.message.seq) for sample in inputs]))
        commands = [
            BaseCommand(left_mps=0.1, right_mps=0.1) for sample in inputs if isinstance(sample.message, Detections)
        ]
        return [Output(topics.BASE_COMMAND, command) for command in commands]

    @property
    def times_ms(self) -> list[int]:
        return [now_ns // MS for now_ns, _ in self.steps]


class Driven:
    """A node that drives an echo, and one that feeds it."""

    def __init__(self, core: Echo | None = None, clock: Clock | None = None, **options: Any) -> None:
        self.core = core or Echo()
        self.mesh = Mesh(clock)
        self.node = self.mesh.node("planning", **options)
        self.feeder = self.mesh.node("feeder")
        self.tap = self.mesh.tap()

    async def __aenter__(self) -> Driven:
        await self.feeder.__aenter__()
        await self.node.__aenter__()
        self.driving = asyncio.create_task(self.node.drive(self.core))
        return self

    async def __aexit__(self, *_: object) -> None:
        self.driving.cancel()
        await asyncio.gather(self.driving, return_exceptions=True)
        await self.node.__aexit__()
        await self.feeder.__aexit__()

    def commands(self) -> list[BaseCommand]:
        return self.tap.messages(topics.BASE_COMMAND)


@in_virtual_time
async def test_a_core_is_stepped_at_its_rate_and_at_once_when_a_trigger_comes() -> None:
    async with Driven() as driven:
        await asyncio.sleep(0.030)
        driven.feeder.publish(topics.DETECTIONS, seen())
        await asyncio.sleep(0.040)
        assert driven.core.times_ms == [0, 20, 30, 40, 60]


@in_virtual_time
async def test_what_is_no_trigger_waits_for_the_next_step() -> None:
    async with Driven() as driven:
        await asyncio.sleep(0.025)
        driven.feeder.publish(topics.BASE_STATE, state())
        driven.feeder.publish(topics.BASE_STATE, state())
        await asyncio.sleep(0.030)
        assert driven.core.steps[2] == (40 * MS, [("base/state", 1)])


@in_virtual_time
async def test_a_core_without_a_rate_is_stepped_by_its_triggers_alone() -> None:
    async with Driven(Echo(rate_hz=None)) as driven:
        await asyncio.sleep(10.0)
        assert driven.core.steps == []
        for _ in range(3):
            driven.feeder.publish(topics.DETECTIONS, seen())
        await settle()
        assert [inputs for _, inputs in driven.core.steps] == [[("perception/detections", seq) for seq in range(3)]]


@in_virtual_time
async def test_no_trigger_is_lost_while_a_step_takes_its_time() -> None:
    async with Driven(Echo(rate_hz=None), latency_s=0.1) as driven:
        for number in range(20):
            await asyncio.sleep(0.03 * (number % 5))
            driven.feeder.publish(topics.DETECTIONS, seen())
        await asyncio.sleep(1.0)
        assert [seq for _, inputs in driven.core.steps for _, seq in inputs] == list(range(20))
        assert len(driven.commands()) == 20


@in_virtual_time
async def test_latency_makes_outputs_late_and_says_so_in_their_stamp() -> None:
    async with Driven(latency_s=0.1) as driven:
        await asyncio.sleep(0.010)
        driven.feeder.publish(topics.DETECTIONS, seen())
        await asyncio.sleep(0.099)
        assert driven.commands() == []
        await asyncio.sleep(0.002)
        assert [command.stamp_ns for command in driven.commands()] == [110 * MS]


@in_virtual_time
async def test_a_core_that_fails_ends_its_service() -> None:
    driven = Driven()
    driven.core.raises = ZeroDivisionError("of the core's own")
    async with driven:
        with pytest.raises(ZeroDivisionError, match="of the core's own"):
            await driven.driving


@in_virtual_time
async def test_when_the_clock_begins_anew_a_core_is_stepped_at_once_and_at_its_rate_from_then_on() -> None:
    clock = JumpingClock()
    clock.jump_to(1000.0)
    async with Driven(clock=clock) as driven:
        await asyncio.sleep(0.05)
        clock.jump_to(3.0)
        await asyncio.sleep(0.05)
        assert driven.core.times_ms == [1_000_000, 1_000_020, 1_000_040, 3_000, 3_020, 3_040]


@in_virtual_time
async def test_what_was_computed_before_the_clock_began_anew_is_not_said_after_it() -> None:
    clock = JumpingClock()
    clock.jump_to(1000.0)
    async with Driven(clock=clock, latency_s=0.1) as driven:
        await asyncio.sleep(0.005)
        driven.feeder.publish(topics.DETECTIONS, seen())
        await asyncio.sleep(0.05)
        clock.jump_to(3.0)
        await asyncio.sleep(0.5)
        assert driven.commands() == []
        after = [now_ms for now_ms in driven.core.times_ms if now_ms < 1_000_000]
        assert after[:3] == [3_000, 3_020, 3_040]


@in_virtual_time
async def test_a_core_that_is_too_slow_for_its_rate_leaves_others_their_turn() -> None:
    clock = JumpingClock()

    class Slow(Echo):
        def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
            clock.jump_to(now_ns / NS + 0.030)
            return super().step(inputs, now_ns)

    async with Driven(Slow(), clock=clock) as driven:
        turns = 0
        while len(driven.core.steps) < 10:
            await asyncio.sleep(0)
            turns += 1
            assert turns < 1000
        driven.feeder.publish(topics.DETECTIONS, seen())
        await settle()
        assert driven.commands()


# --- the record of steps --------------------------------------------------------------------------


@in_virtual_time
async def test_a_record_says_what_a_step_consumed_and_gave_in_order() -> None:
    async with Driven(Echo(rate_hz=None), record_steps=True) as driven:
        await asyncio.sleep(RECORDER_S + 1.0)  # it waits for a recorder first, and there is none
        now_ns = driven.node.now_ns()
        for _ in range(2):
            driven.feeder.publish(topics.BASE_STATE, state())
            driven.feeder.publish(topics.DETECTIONS, seen())
        await settle()
        (record,) = driven.tap.messages(topics.STEPS.of("planning"))
        states = driven.feeder.publisher(topics.BASE_STATE).incarnation
        detections = driven.feeder.publisher(topics.DETECTIONS).incarnation
        commands = driven.node.publisher(topics.BASE_COMMAND).incarnation
        assert record == StepRecord(
            stamp_ns=now_ns,
            seq=0,
            incarnation=record.incarnation,
            now_ns=now_ns,
            core="planning",
            consumed=(
                ("base/state", states, 1),
                ("perception/detections", detections, 0),
                ("perception/detections", detections, 1),
            ),
            produced=(("base/command", commands, 0), ("base/command", commands, 1)),
        )


@in_virtual_time
async def test_steps_are_recorded_only_when_that_is_asked_for() -> None:
    async with Driven() as driven:
        await asyncio.sleep(1.0)
        assert driven.tap.messages(topics.STEPS.of("planning")) == []


# --- requests -------------------------------------------------------------------------------------


async def answered(question: CancelRequest) -> TaskReply:
    return TaskReply(accepted=True, task_id=question.task_id)


@in_virtual_time
async def test_a_request_is_answered() -> None:
    mesh = Mesh()
    async with mesh.node("executive") as server, mesh.node("operator") as caller:
        server.serve(topics.CANCEL, answered)
        assert (await caller.call(topics.CANCEL, CancelRequest(task_id="t"))).task_id == "t"


@in_virtual_time
async def test_a_request_that_nobody_answers_says_what_to_start() -> None:
    async with Mesh().node("operator") as caller:
        with pytest.raises(MeshError, match=r"nobody answers calliope/executive/cancel: is executive running\?"):
            await caller.call(topics.CANCEL, CancelRequest())


@in_virtual_time
async def test_a_request_whose_server_hangs_times_out() -> None:
    async def hang(_: CancelRequest) -> TaskReply:
        await asyncio.sleep(1e6)
        raise AssertionError("never")

    mesh = Mesh()
    async with mesh.node("executive") as server, mesh.node("operator") as caller:
        server.serve(topics.CANCEL, hang)
        with pytest.raises(CallTimeoutError):
            await caller.call(topics.CANCEL, CancelRequest(), timeout_s=0.5)
        assert caller.now_ns() == NS // 2


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (ConfigError("the file is not there"), "the file is not there"),
        (KeyError("inside"), "executive/cancel: internal error in executive: 'inside'"),
    ],
)
def test_a_handlers_error_reaches_the_caller_in_words(error: Exception, says: str) -> None:
    async def fail(_: CancelRequest) -> TaskReply:
        raise error

    @in_virtual_time
    async def scenario() -> None:
        mesh = Mesh()
        async with mesh.node("executive") as server, mesh.node("operator") as caller:
            server.serve(topics.CANCEL, fail)
            with pytest.raises(RemoteError, match=says):
                await caller.call(topics.CANCEL, CancelRequest())

    scenario()


@pytest.mark.parametrize(
    ("garbage", "says"),
    [
        (b"", b"not a good CancelRequest"),
        (b"\xc1", b"not a good CancelRequest"),
        (msgspec.msgpack.encode({"task_id": 3}), b"not a good CancelRequest"),
        (b"\x81" * 50_000, b"not a good CancelRequest"),
        (bytes(2**20 + 1), b"a question of 1048577 bytes"),
    ],
)
def test_a_malformed_question_is_answered_with_an_error_and_the_server_lives(garbage: bytes, says: bytes) -> None:
    @in_virtual_time
    async def scenario() -> None:
        mesh = Mesh()
        async with mesh.node("executive") as server, mesh.node("operator") as caller:
            server.serve(topics.CANCEL, answered)
            (reply,) = await caller.bus.call(topics.CANCEL.key("calliope"), garbage, 1.0)
            assert not reply.ok
            assert says in reply.payload
            assert (await caller.call(topics.CANCEL, CancelRequest())).accepted

    scenario()


@pytest.mark.parametrize("garbage", [b"", b"\xc1", b"\xa1\xff", b"\x81" * 50_000])
def test_a_malformed_answer_is_the_servers_fault_and_said_so(garbage: bytes) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async def answer(_key: str, _payload: object) -> bytes:
            return garbage

        mesh = Mesh()
        async with mesh.node("operator") as caller:
            mesh.mesh.join().serve(topics.CANCEL.key("calliope"), answer)
            with pytest.raises(
                RemoteError, match="calliope/executive/cancel answered something that is not a TaskReply"
            ):
                await caller.call(topics.CANCEL, CancelRequest())

    scenario()


@in_virtual_time
async def test_everyone_can_be_asked_at_once_and_those_that_fail_are_left_out() -> None:
    mesh = Mesh()
    async with mesh.node("base") as base, mesh.node("arm") as arm, mesh.node("operator") as caller:

        async def latch(request: EstopRequest) -> EstopReply:
            return EstopReply(service="base", latch="latched")

        async def fail(request: EstopRequest) -> EstopReply:
            raise ConfigError("no")

        base.serve(topics.ESTOP.of("base"), latch)
        arm.serve(topics.ESTOP.of("arm"), fail)
        replies = await caller.call_all(topics.ESTOP.of("*"), EstopRequest(latched=True))
        assert [reply.service for reply in replies] == ["base"]


# --- life, health and end -------------------------------------------------------------------------


@in_virtual_time
async def test_a_service_is_alive_from_ready_to_its_end() -> None:
    mesh, news = Mesh(), []
    async with mesh.node("watcher") as watcher:
        watcher.watch_alive(lambda service, alive: news.append((service, alive)))
        async with mesh.node("base") as node:
            await settle()
            assert news == []
            node.ready("works")
            node.ready("still works")
            await settle()
            assert news == [("base", True)]
        await settle()
        assert news == [("base", True), ("base", False)]


@in_virtual_time
async def test_health_tells_of_every_topic_and_loop() -> None:
    mesh = Mesh()
    async with mesh.node("base") as node, mesh.node("feeder") as feeder:
        node.ready("works")
        node.stream(topics.BASE_COMMAND)

        async def loop() -> None:
            async for _ in node.every(10.0, "beat"):
                node.publish(topics.BASE_STATE, state())

        node.spawn(loop())
        healths = feeder.stream(topics.HEALTH, service="base")
        feeder.publish(topics.BASE_COMMAND, BaseCommand(left_mps=0.0, right_mps=0.0))
        mesh.mesh.publish(topics.BASE_COMMAND.key("calliope"), b"\xc1")
        await asyncio.sleep(3.5)
        _, first, second = await healths.next(), await healths.next(), await healths.next()
        assert (second.stamp_ns - first.stamp_ns) / NS == pytest.approx(1.0)
        assert (second.service, second.state, second.text) == ("base", "ready", "works")
        ports = {(port.key, port.direction): port for port in second.topics}
        command = ports["calliope/base/command", "in"]
        assert (command.count, command.rejected) == (1, 1)
        assert command.last_error
        assert ports["calliope/base/state", "out"].rate_hz == pytest.approx(10.0)
        assert [loop.name for loop in second.loops] == ["beat"]
        assert second.loops[0].period_median_ms == pytest.approx(100.0)


@in_virtual_time
async def test_background_work_that_fails_degrades_its_node_and_nothing_else(caplog: pytest.LogCaptureFixture) -> None:
    async def fail() -> None:
        raise ZeroDivisionError("in the background")

    async with Mesh().node("base") as node:
        node.spawn(fail())
        await settle()
        assert node.state == "degraded"
        assert "in the background" in node.text
    assert [record.levelno for record in caplog.records] == [logging.ERROR]


@in_virtual_time
async def test_a_node_that_ends_leaves_nothing_behind() -> None:
    mesh = Mesh()
    async with mesh.node("other") as other:
        before = (len(asyncio.all_tasks()), len(mesh.mesh.subscriptions), len(mesh.mesh.servers))
        async with mesh.node("base") as node:
            node.ready()
            heard: list[Message] = []
            node.on(topics.INTENT, heard.append)
            node.serve(topics.CANCEL, answered)
            node.watch_alive(lambda service, alive: None)
            node.spawn(asyncio.sleep(1e6))
            await settle()
        other.publish(topics.INTENT, Intent())
        await settle()
        assert (len(asyncio.all_tasks()), len(mesh.mesh.subscriptions), len(mesh.mesh.servers)) == before
        assert len(mesh.mesh.watchers) == 0
        assert heard == []


@in_virtual_time
async def test_driving_that_is_cancelled_leaves_no_task_behind() -> None:
    before = asyncio.all_tasks()
    async with Driven() as driven:
        await asyncio.sleep(0.033)
        assert not driven.driving.done()
    await settle()
    assert asyncio.all_tasks() == before


@in_virtual_time
async def test_a_part_of_a_process_is_a_service_of_its_own() -> None:
    mesh = Mesh()
    async with mesh.node("sim", robot_name="ada") as sim, sim.sibling("base") as base:
        base.ready()
        assert (base.name, base.robot_name) == ("base", "ada")
        assert await sim.bus.alive("ada/*/alive") == ["ada/base/alive"]
