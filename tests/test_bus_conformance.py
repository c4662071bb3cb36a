"""What a bus promises, tried on both: the local one in virtual time, the zenoh one over Unix sockets."""

from __future__ import annotations

import asyncio
import functools
import itertools
import os
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Protocol

import pytest

from cocoro.bus.base import Bus, Heard, Payload
from cocoro.bus.endpoints import default
from cocoro.bus.local import LocalBus, LocalMesh
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import CallTimeoutError, ConfigError
from cocoro.topics import Qos
from cocoro.vloop import run_virtual

PATIENCE_S = 30.0


class Mesh(Protocol):
    def run(self, scenario: Coroutine[Any, Any, None]) -> None: ...

    async def join(self) -> Bus: ...

    async def drop(self, bus: Bus) -> None:
        """End a participant without its taking back anything itself."""


class Local:
    def __init__(self) -> None:
        self.mesh = LocalMesh()

    def run(self, scenario: Coroutine[Any, Any, None]) -> None:
        run_virtual(scenario)

    async def join(self) -> Bus:
        return self.mesh.join()

    async def drop(self, bus: Bus) -> None:
        assert isinstance(bus, LocalBus)
        bus.kill()


class Zenoh:
    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir

    def run(self, scenario: Coroutine[Any, Any, None]) -> None:
        asyncio.run(scenario)

    async def join(self) -> Bus:
        return await ZenohBus.open(default("robot", "test", self.run_dir))

    async def drop(self, bus: Bus) -> None:
        await bus.close()


@pytest.fixture(params=["local", pytest.param("zenoh", marks=pytest.mark.zenoh)])
def mesh(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Mesh:
    return Local() if request.param == "local" else Zenoh(tmp_path_factory.mktemp("m"))


Scenario = Callable[..., Coroutine[Any, Any, None]]


def scenario(test: Scenario) -> Callable[..., None]:
    """A test that is a coroutine: run on the mesh's own kind of loop, with a limit that only a failure reaches."""

    @functools.wraps(test)
    def run(mesh: Mesh, **fixtures: Any) -> None:
        mesh.run(asyncio.wait_for(test(mesh, **fixtures), PATIENCE_S))

    return run


@asynccontextmanager
async def joined(mesh: Mesh, count: int) -> AsyncIterator[list[Bus]]:
    buses = [await mesh.join() for _ in range(count)]
    try:
        yield buses
    finally:
        for bus in buses:
            await bus.close()


class Inbox:
    """Collects what a subscription gives, and lets a test wait for what it must contain."""

    def __init__(self) -> None:
        self.samples: list[tuple[str, bytes]] = []
        self._came = asyncio.Event()

    def __call__(self, key: str, payload: Payload) -> None:
        self.samples.append((key, bytes(payload)))
        self._came.set()

    @property
    def payloads(self) -> list[bytes]:
        return [payload for _, payload in self.samples]

    async def until(self, content: Callable[[], bool]) -> None:
        while not content():
            self._came.clear()
            await self._came.wait()

    async def has(self, payload: bytes) -> None:
        await self.until(lambda: payload in self.payloads)


class Listener:
    """Collects lots, and lets a test wait for so many samples."""

    def __init__(self) -> None:
        self.lots: list[list[Heard]] = []
        self._came = asyncio.Event()

    def __call__(self, lot: list[Heard]) -> None:
        self.lots.append(lot)
        self._came.set()

    @property
    def heard(self) -> list[Heard]:
        return [each for lot in self.lots for each in lot]

    async def has(self, count: int) -> None:
        while len(self.heard) < count:
            self._came.clear()
            await self._came.wait()


numbers = itertools.count()


async def known(who: Bus, *by: Bus) -> None:
    """Wait until others know all that a bus has declared so far: declarations arrive in their order."""
    key = f"known/{next(numbers)}"
    token = who.declare_alive(key)
    for bus in by:
        await appears(bus, key)
    token.close()


async def appears(bus: Bus, key: str, alive: bool = True) -> None:
    seen = asyncio.Event()
    with_state = {True: seen.set, False: lambda: None} if alive else {True: lambda: None, False: seen.set}
    watch = bus.watch_alive(key, lambda _, state: with_state[state]())
    await seen.wait()
    watch.close()


async def echo(key: str, payload: Payload) -> bytes:
    return key.encode() + b":" + bytes(payload)


@scenario
async def test_a_sample_reaches_every_subscriber_with_its_key(mesh: Mesh) -> None:
    async with joined(mesh, 3) as (a, b, c):
        inboxes = [Inbox(), Inbox()]
        for bus, inbox in zip((b, c), inboxes, strict=True):
            bus.subscribe("robot/base/state", Qos.STATE, inbox, depth=1)
            await known(bus, a)
        a.publisher("robot/base/state", Qos.STATE).put(b"still")
        for inbox in inboxes:
            await inbox.has(b"still")
            assert inbox.samples == [("robot/base/state", b"still")]


@scenario
async def test_a_publisher_hears_itself(mesh: Mesh) -> None:
    async with joined(mesh, 1) as (a,):
        inbox = Inbox()
        a.subscribe("robot/x", Qos.COMMAND, inbox, depth=1)
        a.publisher("robot/x", Qos.COMMAND).put(b"me")
        await inbox.has(b"me")


@pytest.mark.parametrize(
    ("expression", "heard"),
    [
        ("robot/*/health", ["robot/arm/health", "robot/base/health"]),
        ("robot/**", ["robot/arm/health", "robot/arm/state", "robot/base/health"]),
        ("*/arm/*", ["other/arm/health", "robot/arm/health", "robot/arm/state"]),
        ("robot/arm/state", ["robot/arm/state"]),
        ("**/state", ["robot/arm/state"]),
    ],
)
@scenario
async def test_key_expressions_choose_what_is_heard(mesh: Mesh, expression: str, heard: list[str]) -> None:
    keys = ["robot/arm/health", "robot/arm/state", "robot/base/health", "other/arm/health"]
    async with joined(mesh, 2) as (a, b):
        inbox, last = Inbox(), Inbox()
        b.subscribe(expression, Qos.EVENT, inbox, depth=1)
        b.subscribe("last", Qos.EVENT, last, depth=1)
        await known(b, a)
        for key in [*keys, "last"]:
            a.publisher(key, Qos.EVENT).put(b"x")
        await last.has(b"x")
        assert sorted(key for key, _ in inbox.samples) == heard


@scenario
async def test_two_robots_on_one_mesh_do_not_mix(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        one, two = Inbox(), Inbox()
        b.subscribe("one/**", Qos.EVENT, one, depth=1)
        b.subscribe("two/**", Qos.EVENT, two, depth=1)
        await known(b, a)
        a.publisher("one/base/state", Qos.EVENT).put(b"1")
        a.publisher("two/base/state", Qos.EVENT).put(b"2")
        await one.has(b"1")
        await two.has(b"2")
        assert one.payloads == [b"1"]
        assert two.payloads == [b"2"]


@scenario
async def test_a_late_subscriber_gets_the_next_sample(mesh: Mesh) -> None:
    async with joined(mesh, 1) as (a,):
        publisher = a.publisher("robot/x", Qos.STATE)
        publisher.put(b"too early")
        async with joined(mesh, 1) as (late,):
            inbox = Inbox()
            late.subscribe("robot/x", Qos.STATE, inbox, depth=1)
            await known(late, a)
            publisher.put(b"in time")
            await inbox.has(b"in time")
            assert inbox.payloads == [b"in time"]


@scenario
async def test_a_publication_right_after_joining_reaches_those_who_wait_for_it(mesh: Mesh) -> None:
    async with joined(mesh, 3) as readers:
        inboxes = [Inbox() for _ in readers]
        for bus, inbox in zip(readers, inboxes, strict=True):
            bus.subscribe("robot/x", Qos.COMMAND, inbox, depth=1)
        async with joined(mesh, 1) as (late,):
            late.publisher("robot/x", Qos.COMMAND).put(b"at once")
            for inbox in inboxes:
                await inbox.has(b"at once")


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
async def test_a_slow_reader_gets_the_newest_and_the_rest_is_counted(mesh: Mesh) -> None:
    sent = 1000
    async with joined(mesh, 2) as (a, b):
        inbox = Inbox()
        subscription = b.subscribe("robot/x", Qos.STATE, inbox, depth=1)
        await known(b, a)
        publisher = a.publisher("robot/x", Qos.STATE)
        for number in range(sent):
            publisher.put(b"%d" % number)
        await inbox.has(b"%d" % (sent - 1))
        received = [int(payload) for payload in inbox.payloads]
        assert received == sorted(set(received))
        assert subscription.skipped > 0
        assert len(received) + subscription.skipped == sent


@scenario
async def test_depth_keeps_the_newest_of_each_key(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        inbox, last = Inbox(), Inbox()
        subscription = b.subscribe("robot/*", Qos.STATE, inbox, depth=3)
        b.subscribe("last", Qos.STATE, last, depth=1)
        await known(b, a)
        publishers = {name: a.publisher(f"robot/{name}", Qos.STATE) for name in ("x", "y")}
        for number in range(500):
            for publisher in publishers.values():
                publisher.put(b"%d" % number)
        a.publisher("last", Qos.STATE).put(b"end")
        await last.has(b"end")
        await inbox.until(lambda: all((f"robot/{name}", b"499") in inbox.samples for name in publishers))
        for name in publishers:
            numbers = [int(payload) for key, payload in inbox.samples if key == f"robot/{name}"]
            assert numbers[-3:] == [497, 498, 499]
            assert numbers == sorted(set(numbers))
        assert len(inbox.samples) + subscription.skipped == 1000


@scenario
async def test_events_all_arrive_in_order(mesh: Mesh) -> None:
    sent = 10_000
    async with joined(mesh, 2) as (a, b):
        inbox = Inbox()
        subscription = b.subscribe("robot/task", Qos.EVENT, inbox, depth=1)
        await known(b, a)
        publisher = a.publisher("robot/task", Qos.EVENT)
        for number in range(sent):
            publisher.put(b"%d" % number)
        await inbox.until(lambda: len(inbox.samples) >= sent)
        assert [int(payload) for payload in inbox.payloads] == list(range(sent))
        assert subscription.skipped == 0


@scenario
async def test_a_large_payload_arrives_bit_for_bit(mesh: Mesh) -> None:
    frames = [os.urandom(1_536_000) for _ in range(3)]
    async with joined(mesh, 2) as (a, b):
        inbox = Inbox()
        b.subscribe("robot/frame", Qos.FRAME, inbox, depth=1)
        await known(b, a)
        publisher = a.publisher("robot/frame", Qos.FRAME)
        for frame in frames:
            publisher.put(memoryview(frame))
            await inbox.until(lambda frame=frame: bool(inbox.samples) and inbox.payloads[-1] == frame)  # type: ignore[misc]
        assert inbox.payloads == frames


@scenario
async def test_a_publisher_may_use_its_buffer_again(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        inbox = Inbox()
        b.subscribe("robot/x", Qos.EVENT, inbox, depth=1)
        await known(b, a)
        publisher, buffer = a.publisher("robot/x", Qos.EVENT), bytearray(b"one")
        publisher.put(memoryview(buffer))
        buffer[:] = b"two"
        publisher.put(memoryview(buffer))
        await inbox.has(b"two")
        assert inbox.payloads == [b"one", b"two"]


@scenario
async def test_a_reader_that_fails_gets_the_next_sample_all_the_same(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        reported: list[str] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: reported.append(context["message"]))
        inbox = Inbox()

        def fail_once(key: str, payload: Payload) -> None:
            if payload == b"bad":
                raise ValueError("cannot read this")
            inbox(key, payload)

        b.subscribe("robot/x", Qos.EVENT, fail_once, depth=1)
        await known(b, a)
        publisher = a.publisher("robot/x", Qos.EVENT)
        publisher.put(b"bad")
        publisher.put(b"good")
        await inbox.has(b"good")
        assert reported == ["the reader of robot/x failed"]


@scenario
async def test_who_listens_hears_all_in_order_in_few_lots_and_what_has_come_when_it_ends(mesh: Mesh) -> None:
    async with joined(mesh, 2) as (a, b):
        listener, last, every_s = Listener(), Inbox(), 0.2
        listening = b.listen("robot/**", listener, every_s)
        b.subscribe("last", Qos.EVENT, last, depth=1)
        await known(b, a)
        publishers = [a.publisher(key, Qos.EVENT) for key in ("robot/x", "robot/y/z")]
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        for number in range(200):
            publishers[number % 2].put(b"%d" % number)
        await listener.has(200)
        most = 200 if isinstance(mesh, Local) else (loop.time() - began_s) / every_s + 2
        assert len(listener.lots) <= most

        for number in range(200, 300):
            publishers[number % 2].put(b"%d" % number)
        a.publisher("last", Qos.EVENT).put(b"")
        await last.has(b"")
        listening.close()
        heard = listener.heard
        assert [bytes(each.payload) for each in heard] == [b"%d" % number for number in range(300)]
        assert [each.key for each in heard] == ["robot/x", "robot/y/z"] * 150
        times = [each.heard_ns for each in heard]
        assert times == sorted(times)
        publishers[0].put(b"more")
        a.publisher("last", Qos.EVENT).put(b"again")
        await last.has(b"again")
        assert len(listener.heard) == 300


@scenario
async def test_who_fails_at_a_lot_gets_the_next_one(mesh: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    async with joined(mesh, 1) as (a,):
        listener = Listener()

        def fail_once(lot: list[Heard]) -> None:
            listener(lot)
            if len(listener.heard) == 1:
                raise RuntimeError("once")

        a.listen("robot/x", fail_once, 0.01)
        publisher = a.publisher("robot/x", Qos.EVENT)
        publisher.put(b"bad")
        await listener.has(1)
        publisher.put(b"good")
        await listener.has(2)
        assert "failed" in caplog.text


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


async def silent(key: str, payload: Payload) -> bytes:
    await asyncio.get_running_loop().create_future()
    raise AssertionError("never")


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
