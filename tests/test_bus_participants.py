"""Participants of either bus: the tokens that tell who lives, dying and coming back, closing, and incarnations."""

from __future__ import annotations

import asyncio

from bus_rig import PATIENCE_S, Inbox, Mesh, echo, joined, known, scenario

from cocoro.bus.base import Qos
from cocoro.bus.local import LocalMesh


@scenario
async def test_a_watcher_hears_of_tokens_that_live_already_and_of_changes(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        early = a.declare_alive("robot/base/alive")
        await known(a, b)
        news: asyncio.Queue[tuple[str, bool]] = asyncio.Queue()
        b.watch_alive("robot/*/alive", lambda key, alive: news.put_nowait((key, alive)))
        assert await news.get() == ("robot/base/alive", True)
        late = a.declare_alive("robot/arm/alive")
        assert await news.get() == ("robot/arm/alive", True)
        a.declare_alive("other/arm/alive")
        early.close()
        early.close()
        assert await news.get() == ("robot/base/alive", False)
        assert await b.alive("robot/*/alive") == ["robot/arm/alive"]
        assert await a.alive("**") == ["other/arm/alive", "robot/arm/alive"]
        late.close()
        assert await news.get() == ("robot/arm/alive", False)
        assert await b.alive("robot/**") == []


@scenario
async def test_a_token_that_two_hold_lives_until_both_are_gone(mesh: Mesh) -> None:
    async with joined(mesh, 3) as (a, b, c):
        news: asyncio.Queue[bool] = asyncio.Queue()
        c.watch_alive("robot/alive", lambda _, alive: news.put_nowait(alive))
        first = a.declare_alive("robot/alive")
        assert await news.get()
        second = b.declare_alive("robot/alive")
        await known(b, c)
        first.close()
        await known(a, c)
        assert await c.alive("robot/alive") == ["robot/alive"]
        second.close()
        assert not await news.get()
        assert news.empty()


@scenario
async def test_a_participant_that_dies_and_comes_back_is_heard_again(mesh: Mesh) -> None:
    async with joined(mesh, 1) as (reader,):
        inbox = Inbox()
        news: asyncio.Queue[bool] = asyncio.Queue()
        reader.subscribe("robot/x", Qos.EVENT, inbox, depth=1)
        reader.watch_alive("robot/alive", lambda _, alive: news.put_nowait(alive))
        for life in range(3):
            service = await mesh.join()
            service.serve("robot/run", echo)
            service.declare_alive("robot/alive")
            assert await news.get()
            service.publisher("robot/x", Qos.EVENT).put(b"life %d" % life)
            await inbox.has(b"life %d" % life)
            assert len(await reader.call("robot/run", b"", PATIENCE_S)) == 1
            await mesh.drop(service)
            assert not await news.get()
            assert await reader.call("robot/run", b"", PATIENCE_S) == []
            assert await reader.alive("**") == []


@scenario
async def test_nothing_calls_back_after_close(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, other):
        left = await mesh.join()
        inbox, news = Inbox(), Inbox()
        left.subscribe("robot/x", Qos.EVENT, inbox, depth=1)
        left.watch_alive("**", lambda key, alive: news(key, b""))
        left.serve("robot/run", echo)
        publisher = left.publisher("robot/y", Qos.EVENT)
        await known(left, a)
        await left.close()
        await left.close()
        heard_before, news_before = list(inbox.samples), list(news.samples)

        witness = Inbox()
        other.subscribe("robot/**", Qos.EVENT, witness, depth=1)
        await known(other, a)
        publisher.put(b"nobody hears this")
        a.publisher("robot/x", Qos.EVENT).put(b"x")
        await witness.has(b"x")
        assert witness.payloads == [b"x"]
        assert inbox.samples == heard_before
        assert news.samples == news_before
        assert await a.call("robot/run", b"", PATIENCE_S) == []


@scenario
async def test_a_closed_subscription_hears_no_more_and_others_do(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        closed, kept = Inbox(), Inbox()
        subscription = b.subscribe("robot/x", Qos.EVENT, closed, depth=1)
        b.subscribe("robot/x", Qos.EVENT, kept, depth=1)
        await known(b, a)
        subscription.close()
        subscription.close()
        publisher = a.publisher("robot/x", Qos.EVENT)
        publisher.put(b"1")
        await kept.has(b"1")
        publisher.close()
        publisher.put(b"2")
        a.publisher("robot/x", Qos.EVENT).put(b"3")
        await kept.has(b"3")
        assert kept.payloads == [b"1", b"3"]
        assert closed.payloads == []


@scenario
async def test_incarnations_are_all_different(mesh: Mesh) -> None:
    async with joined(mesh, 2) as buses:
        drawn = [bus.new_incarnation() for bus in buses for _ in range(100)]
        assert len(set(drawn)) == len(drawn)
        assert all(0 <= number < 2**53 for number in drawn)


def test_incarnations_of_the_local_bus_are_the_same_in_each_run() -> None:
    assert [LocalMesh().join().new_incarnation() for _ in range(2)] == [1, 1]
