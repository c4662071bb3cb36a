"""Samples on either bus: who hears which, what is kept of them and in which order."""

from __future__ import annotations

import asyncio
import os

import pytest
from bus_rig import Inbox, Listener, Local, Mesh, joined, known, scenario

from cocoro.bus.base import Payload, Qos, Received


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
async def test_who_listens_hears_all_in_order_in_few_batches_and_what_has_come_when_it_ends(mesh: Mesh) -> None:
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
        assert len(listener.batches) <= most

        for number in range(200, 300):
            publishers[number % 2].put(b"%d" % number)
        a.publisher("last", Qos.EVENT).put(b"")
        await last.has(b"")
        listening.close()
        heard = listener.heard
        assert [bytes(each.payload) for each in heard] == [b"%d" % number for number in range(300)]
        assert [each.key for each in heard] == ["robot/x", "robot/y/z"] * 150
        times = [each.received_ns for each in heard]
        assert times == sorted(times)
        publishers[0].put(b"more")
        a.publisher("last", Qos.EVENT).put(b"again")
        await last.has(b"again")
        assert len(listener.heard) == 300


@scenario
async def test_who_fails_at_a_lot_gets_the_next_one(mesh: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    async with joined(mesh, 1) as (a,):
        listener = Listener()

        def fail_once(batch: list[Received]) -> None:
            listener(batch)
            if len(listener.heard) == 1:
                raise RuntimeError("once")

        a.listen("robot/x", fail_once, 0.01)
        publisher = a.publisher("robot/x", Qos.EVENT)
        publisher.put(b"bad")
        await listener.has(1)
        publisher.put(b"good")
        await listener.has(2)
        assert "failed" in caplog.text
