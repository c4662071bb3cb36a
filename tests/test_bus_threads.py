"""The parts between zenoh's threads and the event loop: ring, outbox and pool of shared memory."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextvars import Context
from pathlib import Path
from typing import TypeVarTuple

import zenoh
from zenoh.handlers import Callback
from zenoh_rig import FRAME, PATIENCE_S, appears, local, scenario

from cocoro.bus.base import Qos
from cocoro.bus.declared import SHARED_FROM_BYTES, SharedPool, read
from cocoro.bus.foreign import keep_thread_state
from cocoro.bus.queues import OUTBOX_BYTES, Outbox, Ring
from cocoro.bus.shared import POOL_BYTES
from cocoro.bus.zenoh import ZenohBus

Args = TypeVarTuple("Args")


def test_a_ring_keeps_the_newest_counts_the_rest_and_wakes_the_loop_once() -> None:
    wakes = []

    class Loop(asyncio.SelectorEventLoop):
        def call_soon_threadsafe(
            self, callback: Callable[[*Args], object], *args: *Args, context: Context | None = None
        ) -> asyncio.Handle:
            wakes.append(1)
            return super().call_soon_threadsafe(callback, *args, context=context)

    async def test() -> None:
        got: list[tuple[str, int]] = []
        ring = Ring[int](asyncio.get_running_loop(), lambda key, item: got.append((key, item)), depth=2)

        def push() -> None:
            for n in range(100):
                for key in "ab":
                    ring.push(key, n)

        pushing = threading.Thread(target=push)
        pushing.start()
        pushing.join()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert got == [("a", 98), ("a", 99), ("b", 98), ("b", 99)]
        assert ring.skipped == 196
        assert len(wakes) == 1
        ring.push("a", 100)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert got[-1] == ("a", 100)

    with asyncio.Runner(loop_factory=Loop) as runner:
        runner.run(test())


def test_a_ring_without_depth_keeps_all_in_order_over_all_keys() -> None:
    async def test() -> None:
        got: list[str] = []
        ring = Ring[None](asyncio.get_running_loop(), lambda key, _: got.append(key), depth=None)
        keys = [f"{n % 7}" for n in range(1000)]
        for key in keys:
            ring.push(key, None)
        await asyncio.sleep(0)
        assert got == keys
        assert ring.skipped == 0

    asyncio.run(test())


def test_a_ring_loses_no_count_between_threads() -> None:
    async def test() -> None:
        delivered = 0
        done = asyncio.Event()

        def deliver(key: str, item: int) -> None:
            nonlocal delivered
            delivered += 1

        loop = asyncio.get_running_loop()
        ring = Ring(loop, deliver, depth=1)

        def push() -> None:
            for n in range(5000):
                ring.push("x", n)

        threads = [threading.Thread(target=push, name=str(t)) for t in range(4)]

        def join() -> None:
            for thread in threads:
                thread.join()
            loop.call_soon_threadsafe(done.set)

        for thread in threads:
            thread.start()
        threading.Thread(target=join).start()
        await done.wait()
        await asyncio.sleep(0)
        assert delivered + ring.skipped == 20_000

    asyncio.run(test())


def test_a_ring_whose_loop_is_closed_takes_samples_in_silence() -> None:
    loop = asyncio.new_event_loop()
    ring = Ring[int](loop, lambda key, item: None, depth=None)
    loop.close()
    ring.push("x", 1)
    ring.push("x", 2)
    assert ring._waiting == {}


def test_an_outbox_never_keeps_the_sender_waiting_and_counts_what_it_cannot_take() -> None:
    outbox = Outbox("test")
    go_on = threading.Event()
    sent: list[str] = []

    def send_first() -> None:
        go_on.wait()
        sent.append("first")

    outbox.put(send_first, 1)
    outbox.put(lambda: sent.append("second"), OUTBOX_BYTES - 1)
    outbox.put(lambda: sent.append("too much"), 1)
    assert outbox.lost == 1
    go_on.set()
    outbox.close(PATIENCE_S)
    assert sent == ["first", "second"]


def test_an_outbox_that_cannot_send_ends_all_the_same() -> None:
    outbox, never = Outbox("test"), threading.Event()

    def send() -> None:
        never.wait()

    outbox.put(send, 1)
    outbox.close(0.01)
    never.set()


def test_a_pool_that_is_full_lets_samples_go_by_copy() -> None:
    pool = SharedPool()
    held = [pool.hold(FRAME) for _ in range(POOL_BYTES // len(FRAME) + 2)]
    by_copy = [sample for sample in held if isinstance(sample, bytes)]
    assert pool.missed == len(by_copy) > 0
    shared = [sample for sample in held if not isinstance(sample, bytes)]
    assert len(shared) >= 10
    assert all(read(sample) == FRAME for sample in shared)
    held.clear()
    shared.clear()
    assert not isinstance(pool.hold(FRAME), bytes)


def test_a_small_sample_is_not_put_into_shared_memory() -> None:
    pool = SharedPool()
    small = bytes(SHARED_FROM_BYTES - 1)
    assert pool.hold(small) is small
    assert not isinstance(pool.hold(small + b"1"), bytes)


def test_a_sample_whose_memory_was_taken_back_is_not_read() -> None:
    class Held:
        valid = True

        def is_valid(self) -> bool:
            return self.valid

        def __bytes__(self) -> bytes:
            self.valid = False
            return b"half of one and half of another".ljust(SHARED_FROM_BYTES)

    class Payload:
        def __len__(self) -> int:
            return SHARED_FROM_BYTES

        def as_shm(self) -> Held:
            return Held()

    assert read(Payload()) is None  # type: ignore[arg-type]


@scenario
async def test_a_thread_of_zenoh_keeps_its_state_from_one_message_to_the_next(directory: Path) -> None:
    calls, all_came, loop = threading.local(), asyncio.Event(), asyncio.get_running_loop()
    counted: dict[int, list[int]] = {}

    def on_sample(_: zenoh.Sample) -> None:
        keep_thread_state()
        calls.count = getattr(calls, "count", 0) + 1
        counted.setdefault(threading.get_ident(), []).append(calls.count)
        if sum(map(len, list(counted.values()))) == 100:
            loop.call_soon_threadsafe(all_came.set)

    async with (
        await ZenohBus.open(local(directory, "one", shared_memory=False)) as one,
        await ZenohBus.open(local(directory, "other", shared_memory=False)) as other,
    ):
        subscriber = one._session.declare_subscriber("robot/x", Callback(on_sample, indirect=False))
        one.declare_alive("robot/one")
        await appears(other, "robot/one")
        publisher = other.publisher("robot/x", Qos.EVENT)
        for _ in range(100):
            publisher.put(b"x")
        await all_came.wait()
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    assert all(counts == list(range(1, len(counts) + 1)) for counts in counted.values())
