"""The loop that lends its turn to other threads while it waits."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from cocoro.bus.queues import Ring
from cocoro.lending import LendingLoop


def run(main: Coroutine[Any, Any, None]) -> None:
    with asyncio.Runner(loop_factory=LendingLoop) as runner:
        runner.run(asyncio.wait_for(main, 30.0))


def borrowed(loop: LendingLoop, work: Callable[[], object]) -> bool:
    """Does the work in a borrowed turn, once the loop waits; for a thread."""
    while not loop.borrow():
        pass
    try:
        work()
    finally:
        loop.give_back()
    return True


def test_work_in_a_borrowed_turn_wakes_the_loop_for_what_it_began() -> None:
    async def test() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LendingLoop)
        event, timer, task = asyncio.Event(), asyncio.Event(), asyncio.Event()

        async def work() -> None:
            task.set()

        def begin() -> None:
            assert asyncio.get_running_loop() is loop
            assert threading.get_ident() != loop_thread
            event.set()
            loop.call_later(0.001, timer.set)
            loop.create_task(work())  # noqa: RUF006 # it sets the event before it can be collected

        loop_thread = threading.get_ident()
        with ThreadPoolExecutor(1) as thread:
            done = loop.run_in_executor(thread, borrowed, loop, begin)
            await event.wait()
            await timer.wait()
            await task.wait()
            assert await done

    run(test())


def test_a_borrowed_turn_alone_can_stop_the_loop() -> None:
    loop = LendingLoop()
    with ThreadPoolExecutor(1) as thread:
        done = thread.submit(borrowed, loop, loop.stop)
        loop.run_forever()
        assert done.result()
    loop.close()


def test_a_busy_loop_lends_nothing_and_neither_does_one_that_does_not_run() -> None:
    async def test() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LendingLoop)
        with ThreadPoolExecutor(1) as thread:
            assert not thread.submit(loop.borrow).result()  # this coroutine runs meanwhile

    run(test())
    loop = LendingLoop()
    assert not loop.borrow()
    loop.close()
    assert not loop.borrow()


def test_a_loop_in_debug_mode_does_not_lend() -> None:
    async def test() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LendingLoop)
        loop.set_debug(True)
        tries: list[bool] = []
        over = asyncio.Event()

        def try_it() -> None:
            tries.extend(loop.borrow() for _ in range(1000))
            loop.call_soon_threadsafe(over.set)

        thread = threading.Thread(target=try_it)
        thread.start()
        await over.wait()
        thread.join()
        assert not any(tries)

    run(test())


def test_turns_never_overlap() -> None:
    """Many threads and the loop itself change one number by reading and writing it in two steps."""

    async def test() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LendingLoop)
        count, inside, threads, times = 0, 0, 4, 500

        def step() -> None:
            nonlocal count, inside
            inside += 1
            assert inside == 1
            before = count
            count = before + 1
            inside -= 1

        def borrow() -> None:
            for _ in range(times):
                borrowed(loop, step)

        with ThreadPoolExecutor(threads) as pool:
            working = [loop.run_in_executor(pool, borrow) for _ in range(threads)]
            own = 0
            while not all(future.done() for future in working):
                step()
                own += 1
                await asyncio.sleep(0.0001)
            await asyncio.gather(*working)
        assert count == threads * times + own

    run(test())


def test_a_ring_delivers_in_the_pushing_thread_while_the_loop_waits_and_in_order_when_it_was_busy() -> None:
    async def test() -> None:
        loop = asyncio.get_running_loop()
        got: list[tuple[int, bool]] = []
        everything = asyncio.Event()
        loop_thread = threading.get_ident()

        def deliver(_: str, item: int) -> None:
            got.append((item, threading.get_ident() == loop_thread))
            if item == 99:
                everything.set()

        ring = Ring(loop, deliver, None, borrows=True)
        pushed_while_busy = threading.Event()
        waits = threading.Event()

        def push() -> None:
            for item in range(50):
                ring.push("x", item)
            pushed_while_busy.set()
            waits.wait()
            for item in range(50, 100):
                ring.push("x", item)

        thread = threading.Thread(target=push)
        thread.start()
        pushed_while_busy.wait()  # blocks the loop, so it is busy
        assert got == []
        waits.set()
        await everything.wait()
        thread.join()
        assert [item for item, _ in got] == list(range(100))
        assert all(in_loop for item, in_loop in got if item < 50)

    run(test())


def test_an_exception_in_a_borrowed_turn_goes_to_the_loop_and_the_next_sample_is_delivered() -> None:
    async def test() -> None:
        loop = asyncio.get_running_loop()
        told: list[dict[str, Any]] = []
        loop.set_exception_handler(lambda _, context: told.append(context))
        second = asyncio.Event()

        def deliver(_: str, item: int) -> None:
            if item == 1:
                raise ValueError("bad")
            second.set()

        ring = Ring(loop, deliver, 1 + 1, borrows=True)

        def push() -> None:
            ring.push("x", 1)
            ring.push("x", 2)

        thread = threading.Thread(target=push)
        thread.start()
        await second.wait()
        thread.join()
        (context,) = told
        assert "reader of x failed" in context["message"]
        assert isinstance(context["exception"], ValueError)

    run(test())


@pytest.mark.parametrize("borrows", [True, False])
def test_a_ring_in_any_loop_delivers_everything(borrows: bool) -> None:
    async def test() -> None:
        loop, count = asyncio.get_running_loop(), 0
        everything = asyncio.Event()

        def deliver(_key: str, _item: int) -> None:
            nonlocal count
            count += 1
            if count == 4000:
                everything.set()

        ring = Ring(loop, deliver, None, borrows=borrows)

        def push() -> None:
            for n in range(1000):
                ring.push("x", n)

        threads = [threading.Thread(target=push) for _ in range(4)]
        for thread in threads:
            thread.start()
        await everything.wait()
        for thread in threads:
            thread.join()

    run(test())
    asyncio.run(test())
