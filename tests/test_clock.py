"""Clocks: what time it is, waiting for a time, and what a step of the wall clock does not change."""

from __future__ import annotations

import asyncio
import contextlib
import time

import pytest
from clock_rig import loop_s, started, step_wall_clock

import cocoro.clock
from cocoro.clock import NS, FollowedClock, RealClock, VirtualClock, is_fresh, sleep
from cocoro.vloop import run_virtual

# The virtual clock


def test_the_virtual_clock_is_the_loop_s_time() -> None:
    async def main() -> None:
        clock = VirtualClock()
        assert (clock.now_ns(), clock.epoch) == (0, 0)
        assert await clock.sleep_until(1_500_000_000)
        assert clock.now_ns() == 1_500_000_000
        assert await sleep(clock, 0.25)
        assert clock.now_ns() == 1_750_000_000

    run_virtual(main())


def test_virtual_deadlines_are_met_to_the_nanosecond() -> None:
    async def main() -> None:
        clock = VirtualClock()
        for when_ns in (1, 2, 333_333_333, 333_333_334, 86_400 * NS + 1, 86_400 * NS + 2):
            assert await clock.sleep_until(when_ns)
            assert clock.now_ns() == when_ns

    run_virtual(main())


def test_two_virtual_sleepers_a_nanosecond_apart_wake_at_their_own_times() -> None:
    async def main() -> None:
        clock, woke = VirtualClock(), []

        async def sleeper(when_ns: int) -> None:
            await clock.sleep_until(when_ns)
            woke.append(clock.now_ns())

        await asyncio.gather(sleeper(NS + 1), sleeper(NS), sleeper(NS + 1))
        assert woke == [NS, NS + 1, NS + 1]

    run_virtual(main())


def test_a_cancelled_virtual_sleep_leaves_no_timer() -> None:
    async def main() -> None:
        clock = VirtualClock()
        task = await started(clock.sleep_until(1000 * NS))
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        await asyncio.sleep(1.0)
        assert clock.now_ns() == NS

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize("kind", [VirtualClock, RealClock, FollowedClock])
def test_sleeping_until_the_past_gives_others_their_turn(kind: type[VirtualClock | RealClock | FollowedClock]) -> None:
    async def main() -> None:
        clock = kind()
        turns: list[str] = []
        if isinstance(clock, FollowedClock):
            clock.tick(5 * NS, 1)
        asyncio.get_running_loop().call_soon(turns.append, "other")
        assert await clock.sleep_until(0)
        assert turns == ["other"]
        assert loop_s() == 0.0

    run_virtual(main())


# The real clock


@pytest.mark.usefixtures("real_time")
def test_the_real_clock_reads_as_wall_time_and_sleeps_until_its_time() -> None:
    async def main() -> None:
        clock = RealClock()
        assert clock.now_ns() == 1_000_000 * NS
        assert await clock.sleep_until(clock.now_ns() + 3 * NS + 500)
        assert clock.now_ns() == 1_000_003 * NS + 500
        assert clock.epoch == 0

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_an_offset_that_is_slewed_back_holds_the_time_and_never_turns_it_back() -> None:
    async def main() -> None:
        cell = [1_000 * NS]
        clock = RealClock(cell)
        seen = [clock.now_ns()]
        for _ in range(100):
            cell[0] -= 10_000
            await asyncio.sleep(5e-6)
            seen.append(clock.now_ns())
        assert seen == sorted(seen)
        await asyncio.sleep(1.0)
        assert clock.now_ns() == 1_000 * NS - 1_000_000 + cocoro.clock.steady_ns(), "it has caught up"
        assert clock.epoch == 0

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_an_offset_that_is_set_back_begins_an_epoch_and_wakes_who_waits() -> None:
    async def main() -> None:
        cell = [3_600 * NS]
        clock = RealClock(cell)
        waiting = await started(clock.sleep_until(clock.now_ns() + 5 * NS))
        cell[0] = 0
        assert not await waiting
        assert loop_s() <= RealClock.SLICE_S
        assert clock.now_ns() == cocoro.clock.steady_ns()
        assert clock.epoch == 1

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize("step_s", [-36_000.0, -0.49, -0.01, 0.01, 0.3, 36_000.0])
def test_a_step_of_the_wall_clock_changes_nothing(step_s: float) -> None:
    async def main() -> None:
        clock = RealClock()
        deadline_ns = clock.now_ns() + 10 * NS
        waiting = await started(clock.sleep_until(deadline_ns))
        await asyncio.sleep(0.5)
        before_ns = clock.now_ns()
        step_wall_clock(step_s)
        assert (clock.now_ns(), clock.epoch) == (before_ns, 0)
        assert await waiting
        assert loop_s() == pytest.approx(10.0)
        assert clock.now_ns() == deadline_ns

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_processes_with_one_offset_have_one_time_whenever_they_start() -> None:
    async def main() -> None:
        first = RealClock()
        step_wall_clock(-0.49)
        restarted, alone = RealClock(first.offset_ns), RealClock()
        assert restarted.now_ns() == first.now_ns()
        assert alone.now_ns() == first.now_ns() - 490_000_000

    run_virtual(main())


def test_what_was_said_before_a_suspension_is_not_fresh_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Linux's CLOCK_BOOTTIME counts the time asleep; the event loop's timers, on CLOCK_MONOTONIC, do not."""

    class Asleep:
        CLOCK_BOOTTIME = "boottime"
        slept_ns = 0

        @classmethod
        def clock_gettime_ns(cls, _: object) -> int:
            return cls.slept_ns + round(asyncio.get_running_loop().time() * NS)

        time_ns = time.time_ns

    monkeypatch.setattr(cocoro.clock, "time", Asleep)

    async def main() -> None:
        clock = RealClock()
        said_ns = clock.now_ns()
        waiting = await started(clock.sleep_until(said_ns + 3600 * NS))
        await asyncio.sleep(0.05)
        assert is_fresh(said_ns, clock.now_ns(), 0.15)
        Asleep.slept_ns = 3600 * NS
        assert not is_fresh(said_ns, clock.now_ns(), 0.15)
        assert await waiting
        assert loop_s() <= RealClock.SLICE_S, "a deadline that passed meanwhile is noticed"

    run_virtual(main())


def test_on_this_machine_it_reads_as_wall_time() -> None:
    assert abs(RealClock().now_ns() - time.time_ns()) < NS
