"""Requests between nodes: answers, refusals, silence, and garbage from either side."""

from __future__ import annotations

import asyncio

import msgspec
import pytest
from node_rig import Mesh, answered

from cocoro import topics
from cocoro.bus.base import Payload
from cocoro.clock import NS
from cocoro.errors import CallTimeoutError, ConfigError, MeshError, RemoteError
from cocoro.messages import CancelRequest, EstopReply, EstopRequest, Latch, TaskReply
from cocoro.testing import in_virtual_time


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
async def test_all_services_can_be_called_at_once_and_each_answer_names_its_service() -> None:
    mesh = Mesh()
    async with mesh.node("base") as base, mesh.node("arm") as arm, mesh.node("operator") as caller:

        async def latch(request: EstopRequest) -> EstopReply:
            return EstopReply(service="base", latch="latched")

        async def fail(request: EstopRequest) -> EstopReply:
            raise ConfigError("no")

        base.serve(topics.ESTOP.of("base"), latch)
        arm.serve(topics.ESTOP.of("arm"), fail)
        answers = await caller.call_all(topics.ESTOP.of("*"), EstopRequest())
        assert {answer.service: answer.error for answer in answers} == {"base": "", "arm": "no"}
        assert [answer.reply.latch for answer in answers if answer.reply is not None] == ["latched"]


@in_virtual_time
async def test_the_newest_message_of_a_slow_topic_can_be_asked_for() -> None:
    mesh = Mesh()
    async with mesh.node("executive") as node, mesh.node("operator") as caller:
        assert await caller.newest(topics.LATCH, 1.0) == []
        node.publisher(topics.LATCH)
        assert await caller.newest(topics.LATCH, 1.0) == [], "nothing was said yet"
        for by in ("a", "b"):
            said = node.publish(topics.LATCH, Latch(state="latched", by=by))
        assert await caller.newest(topics.LATCH, 1.0) == [said]
        assert {health.service for health in await caller.newest(topics.HEALTH.of("*"), 1.0)} == {
            "executive",
            "operator",
        }
        assert caller.now_ns() == 0, "nobody waited"


@in_virtual_time
async def test_who_answers_with_something_else_than_its_newest_message_is_not_heard() -> None:
    async def garbage(_key: str, _question: Payload) -> bytes:
        return b"\xc1"

    mesh = Mesh()
    async with mesh.node("operator") as caller:
        mesh.mesh.join().serve(topics.LATCH.key(caller.robot_name), garbage)
        assert await caller.newest(topics.LATCH, 1.0) == []
