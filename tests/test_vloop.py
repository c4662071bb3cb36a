"""Virtual time: it jumps, it keeps order, it says when nothing can happen any more."""

from __future__ import annotations

import asyncio
import random
from typing import Any

import pytest

from cocoro.vloop import NothingScheduledError, VirtualTimeLoop, run_virtual


def now() -> float:
    return asyncio.get_running_loop().time()


def test_a_day_passes_in_no_time() -> None:
    async def main() -> float:
        await asyncio.sleep(2 * 86_400.0)
        return now()

    assert run_virtual(main()) == 2 * 86_400.0


def test_time_starts_at_zero_and_does_not_pass_by_computing() -> None:
    async def main() -> list[float]:
        times = [now()]
        for _ in range(1000):
            await asyncio.sleep(0)
        times.append(now())
        return times

    assert run_virtual(main()) == [0.0, 0.0]


def test_timers_of_equal_deadline_run_in_the_order_of_their_making() -> None:
    async def main() -> list[int]:
        loop = asyncio.get_running_loop()
        order: list[int] = []
        for number in range(500):
            loop.call_at(1.0, order.append, number)
        await asyncio.sleep(2.0)
        return order

    assert run_virtual(main()) == list(range(500))


def test_order_survives_the_cancelling_of_most_timers() -> None:
    async def main() -> list[int]:
        loop = asyncio.get_running_loop()
        order: list[int] = []
        timers = [loop.call_at(1.0, order.append, number) for number in range(1000)]
        for number, timer in enumerate(timers):
            if number % 10:
                timer.cancel()
        await asyncio.sleep(2.0)
        return order

    assert run_virtual(main()) == list(range(0, 1000, 10))


def test_a_deadline_is_met_exactly_and_not_a_nanosecond_early() -> None:
    async def main() -> list[tuple[str, float]]:
        loop, seen = asyncio.get_running_loop(), []
        for name, when in (("late", 1.000000001), ("early", 1.0)):
            loop.call_at(when, lambda name=name: seen.append((name, now())))  # type: ignore[misc]
        await asyncio.sleep(2.0)
        return seen

    assert run_virtual(main()) == [("early", 1.0), ("late", 1.000000001)]


@pytest.mark.parametrize("start_s", [1e6, 1e9, 1e12])
def test_time_goes_on_however_late_it_is(start_s: float) -> None:
    async def main() -> float:
        await asyncio.sleep(start_s)
        for _ in range(10):
            await asyncio.sleep(0.001)
        return now()

    assert run_virtual(main()) >= start_s


async def world(seed: int) -> list[tuple[float, str]]:
    """Tasks that sleep, wait for one another, time out and are cancelled, by chance."""
    chance, log = random.Random(seed), []
    queue: asyncio.Queue[int] = asyncio.Queue(maxsize=3)

    async def produce(name: str) -> None:
        for number in range(20):
            await asyncio.sleep(chance.choice([0.0, 0.1, 0.1, 0.25]))
            await queue.put(number)
            log.append((now(), f"{name} put {number}"))

    async def consume(name: str) -> None:
        while True:
            try:
                async with asyncio.timeout(chance.choice([0.05, 0.1, 1.0])):
                    item = await queue.get()
                log.append((now(), f"{name} got {item}"))
            except TimeoutError:
                log.append((now(), f"{name} waited in vain"))

    consumers = [asyncio.create_task(consume(f"c{n}")) for n in range(3)]
    await asyncio.gather(*(produce(f"p{n}") for n in range(3)))
    for consumer in consumers:
        consumer.cancel()
    await asyncio.gather(*consumers, return_exceptions=True)
    return log


def test_the_same_run_twice_is_the_same_run() -> None:
    first = run_virtual(world(7))
    assert first == run_virtual(world(7))
    assert first != run_virtual(world(8))
    assert [when for when, _ in first] == sorted(when for when, _ in first)


def test_time_outs_are_in_virtual_time() -> None:
    async def main() -> float:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(3600.0):
                await asyncio.get_running_loop().create_future()
        return now()

    assert run_virtual(main()) == 3600.0


def test_what_comes_before_the_time_out_wins() -> None:
    async def main() -> str:
        return await asyncio.wait_for(asyncio.sleep(0.999, "in time"), 1.0)

    assert run_virtual(main()) == "in time"


def test_a_run_that_is_stuck_says_so_and_ends_its_tasks() -> None:
    ended: list[str] = []

    async def wait_for_ever(name: str) -> None:
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            ended.append(name)

    async def main() -> None:
        await asyncio.gather(wait_for_ever("a"), wait_for_ever("b"))

    with pytest.raises(NothingScheduledError, match="every task is waiting"):
        run_virtual(main())
    assert sorted(ended) == ["a", "b"]


def test_a_forgotten_timer_does_not_hide_that_a_run_is_stuck() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        loop.call_later(1.0, lambda: None).cancel()
        loop.call_later(5.0, lambda: None)
        await loop.create_future()

    with pytest.raises(NothingScheduledError):
        run_virtual(main())


def test_tasks_that_are_left_are_cancelled_at_the_end() -> None:
    ended = []

    async def forever() -> None:
        try:
            await asyncio.sleep(1e9)
        finally:
            ended.append(now())

    async def main() -> str:
        task = asyncio.create_task(forever())
        await asyncio.sleep(2.5)
        assert not task.done()
        return "done"

    assert run_virtual(main()) == "done"
    assert ended == [2.5]


def test_an_error_comes_out_as_it_is() -> None:
    async def main() -> Any:
        await asyncio.sleep(1.0)
        raise LookupError("mine")

    with pytest.raises(LookupError, match="mine"):
        run_virtual(main())


def test_a_closed_loop_takes_no_timer() -> None:
    loop = VirtualTimeLoop()
    loop.close()
    with pytest.raises(RuntimeError, match="closed"):
        loop.call_later(1.0, lambda: None)
