"""Requests on either bus: who answers, what a refusal says, and servers that are slow, silent or gone."""

from __future__ import annotations

import asyncio

import pytest
from bus_rig import PATIENCE_S, Mesh, echo, joined, known, scenario

from cocoro.bus.base import Payload
from cocoro.errors import CallTimeoutError, ConfigError


async def silent(key: str, payload: Payload) -> bytes:
    await asyncio.get_running_loop().create_future()
    raise AssertionError("never")


@scenario
async def test_a_call_right_after_joining_reaches_all_servers(mesh: Mesh) -> None:
    async with joined(mesh, 4) as servers:
        for number, bus in enumerate(servers):
            bus.serve(f"robot/s{number}/estop", echo)
        for _ in range(5):
            async with joined(mesh, 1) as (late,):
                replies = await late.call("robot/*/estop", b"!", PATIENCE_S)
                assert sorted(reply.key for reply in replies) == [f"robot/s{n}/estop" for n in range(4)]


@scenario
async def test_every_server_of_a_matching_key_answers(mesh: Mesh) -> None:
    async with joined(mesh, 3) as (a, b, c):
        a.serve("robot/arm/estop", echo)
        b.serve("robot/base/estop", echo)
        a.serve("robot/base/other", echo)
        await known(a, c)
        await known(b, c)
        replies = await c.call("robot/*/estop", b"!", PATIENCE_S)
        assert sorted(replies) == [
            ("robot/arm/estop", True, b"robot/arm/estop:!"),
            ("robot/base/estop", True, b"robot/base/estop:!"),
        ]
        assert all(type(reply.payload) is bytes for reply in replies)


@scenario
async def test_an_empty_request_and_an_empty_answer_pass(mesh: Mesh) -> None:
    async with joined(mesh, 1) as (a,):

        async def nothing(key: str, payload: Payload) -> bytes:
            assert bytes(payload) == b""
            return b""

        a.serve("robot/x", nothing)
        assert await a.call("robot/x", b"", PATIENCE_S) == [("robot/x", True, b"")]


@scenario
async def test_a_server_that_refuses_says_why(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):

        async def refuse(key: str, payload: Payload) -> bytes:
            raise ConfigError("no such object: blau – try red_can")

        a.serve("robot/run", refuse)
        await known(a, b)
        (reply,) = await b.call("robot/run", b"", PATIENCE_S)
        assert reply == ("robot/run", False, "no such object: blau – try red_can".encode())


@scenario
async def test_a_server_that_fails_says_so_and_is_logged(mesh: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    async with joined(mesh, 2) as (a, b):

        async def fail(key: str, payload: Payload) -> bytes:
            raise KeyError("gone")

        a.serve("robot/run", fail)
        await known(a, b)
        (reply,) = await b.call("robot/run", b"", PATIENCE_S)
        assert reply == ("robot/run", False, b"internal error: KeyError: 'gone'")
        assert "the server of robot/run failed" in caplog.text


@scenario
async def test_nobody_serves_is_an_empty_list_at_once(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        a.serve("robot/run", echo)
        await known(a, b)
        assert await b.call("robot/nothing", b"", PATIENCE_S * 10) == []
        assert await b.call("other/**", b"", PATIENCE_S * 10) == []


@scenario
async def test_a_server_that_is_taken_back_serves_no_more(mesh: Mesh) -> None:
    async with joined(mesh, 1) as (a,):
        serving = a.serve("robot/run", echo)
        assert len(await a.call("robot/run", b"", PATIENCE_S)) == 1
        serving.close()
        serving.close()
        assert await a.call("robot/run", b"", PATIENCE_S) == []


@scenario
async def test_no_answer_in_time_is_an_error_and_the_next_call_works(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        a.serve("robot/slow", silent)
        a.serve("robot/quick", echo)
        await known(a, b)
        with pytest.raises(CallTimeoutError, match=r"robot/slow: no answer within 0\.1 s"):
            await b.call("robot/slow", b"", 0.1)
        assert len(await b.call("robot/quick", b"", PATIENCE_S)) == 1


@scenario
async def test_a_silent_server_does_not_hide_the_answers_of_others(mesh: Mesh) -> None:
    async with joined(mesh, 3) as (a, b, c):
        a.serve("robot/a/estop", silent)
        b.serve("robot/b/estop", echo)
        await known(a, c)
        await known(b, c)
        assert [reply.key for reply in await c.call("robot/*/estop", b"", 0.2)] == ["robot/b/estop"]


@scenario
async def test_a_call_that_is_cancelled_leaves_server_and_bus_usable(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        asked, go_on, done = asyncio.Event(), asyncio.Event(), asyncio.Event()

        async def slow(key: str, payload: Payload) -> bytes:
            asked.set()
            await go_on.wait()
            done.set()
            return b"done"

        a.serve("robot/run", slow)
        await known(a, b)
        call = asyncio.create_task(b.call("robot/run", b"", PATIENCE_S))
        await asked.wait()
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
        go_on.set()
        await done.wait()
        assert await b.call("robot/run", b"", PATIENCE_S) == [("robot/run", True, b"done")]


@scenario
async def test_calls_are_served_side_by_side(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        both = asyncio.Barrier(2)

        async def meet(key: str, payload: Payload) -> bytes:
            await both.wait()
            return bytes(payload)

        a.serve("robot/meet", meet)
        await known(a, b)
        answers = await asyncio.gather(*(b.call("robot/meet", name, PATIENCE_S) for name in (b"1", b"2")))
        assert [reply.payload for replies in answers for reply in replies] == [b"1", b"2"]


@scenario
async def test_a_server_that_ends_meanwhile_does_not_keep_its_caller(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        asked = asyncio.Event()

        async def never(key: str, payload: Payload) -> bytes:
            asked.set()
            return await silent(key, payload)

        a.serve("robot/run", never)
        await known(a, b)
        call = asyncio.create_task(b.call("robot/run", b"", PATIENCE_S * 10))
        await asked.wait()
        await mesh.drop(a)
        assert await call == []
