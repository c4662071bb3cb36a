"""Clocks: what time it is, waiting for a time, and what a jump back means."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Coroutine
from typing import Any

import pytest

import cocoro.clock
from cocoro.clock import NS, FollowedClock, RealClock, VirtualClock, is_fresh, sleep
from cocoro.vloop import run_virtual


@pytest.fixture
def real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The system's clocks as the virtual loop's time, from 100 s on, so that a test decides what passes."""

    class Time:
        CLOCK_BOOTTIME = "boottime"
        wall_ns = 1_000_000 * NS

        @classmethod
        def clock_gettime_ns(cls, which: object) -> int:
            assert which == cls.CLOCK_BOOTTIME, "the only clock that decides"
            return 100 * NS + round(asyncio.get_running_loop().time() * NS)

        @classmethod
        def time_ns(cls) -> int:
            return cls.wall_ns + round(asyncio.get_running_loop().time() * NS)

    monkeypatch.setattr(cocoro.clock, "time", Time)


def step_wall_clock(seconds: float) -> None:
    cocoro.clock.time.wall_ns += round(seconds * NS)  # type: ignore[attr-defined]


def loop_s() -> float:
    return asyncio.get_running_loop().time()


async def started(waiting: Coroutine[Any, Any, bool]) -> asyncio.Task[bool]:
    """A task that has come to its first wait."""
    task = asyncio.create_task(waiting)
    for _ in range(5):
        await asyncio.sleep(0)
    return task


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
        clock, turns = kind(), []
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


# The clock that follows the simulator's


@pytest.mark.usefixtures("real_time")
def test_a_followed_clock_starts_with_the_first_tick() -> None:
    async def main() -> None:
        clock = FollowedClock()
        assert (clock.started, clock.now_ns(), clock.epoch) == (False, 0, 0)
        waiting = asyncio.create_task(clock.wait_started())
        await asyncio.sleep(1.0)
        assert not waiting.done()
        clock.tick(7 * NS, incarnation=3)
        await waiting
        assert (clock.started, clock.now_ns(), clock.epoch) == (True, 7 * NS, 0)

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_between_ticks_it_runs_on_at_the_simulator_s_rate_and_then_stands() -> None:
    async def main() -> None:
        clock = FollowedClock(run_on_s=0.03)
        clock.tick(1 * NS, 1, rate=0.5)
        await asyncio.sleep(0.02)
        assert clock.now_ns() == NS + 10_000_000
        await asyncio.sleep(10.0)
        assert clock.now_ns() == NS + 30_000_000

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_a_followed_clock_never_goes_back_within_an_incarnation() -> None:
    async def main() -> None:
        clock, seen = FollowedClock(), []
        for stamp_ms in (0, 8, 17, 20, 15, 33, 34, 34, 50):
            clock.tick(stamp_ms * 1_000_000, 1)
            seen.append(clock.now_ns())
            await asyncio.sleep(0.02)
            seen.append(clock.now_ns())
        assert seen == sorted(seen)
        assert clock.epoch == 0

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_a_late_tick_is_ignored() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(2 * NS, 1)
        clock.tick(1 * NS, 1, rate=0.01)
        await asyncio.sleep(0.01)
        assert clock.now_ns() == 2 * NS + 10_000_000

    run_virtual(main())


TICK_NS = NS // 120


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize("ahead_s", [0.3, 1.0, 3600.0, 2.0**62 / NS])
def test_one_tick_from_far_ahead_moves_nothing(ahead_s: float) -> None:
    async def main() -> None:
        clock = FollowedClock()
        seen = []
        for tick in range(240):
            assert clock.tick(tick * TICK_NS, 1) == ""
            if tick == 100:
                assert "s ahead" in clock.tick(tick * TICK_NS + round(ahead_s * NS), 1)
            seen.append(clock.now_ns())
            await asyncio.sleep(1 / 120)
        assert seen == [tick * TICK_NS for tick in range(240)]
        assert clock.epoch == 0

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_a_tick_that_is_a_little_ahead_holds_time_still_until_the_others_have_caught_up() -> None:
    async def main() -> None:
        clock = FollowedClock()
        stood_s = 0.0
        for tick in range(240):
            if tick == 100:
                assert clock.tick(tick * TICK_NS + NS // 4, 1) == ""
            clock.tick(tick * TICK_NS, 1)
            before_ns = clock.now_ns()
            await asyncio.sleep(1 / 120)
            stood_s += (1 / 120) * (clock.now_ns() == before_ns)
        assert clock.epoch == 0
        assert clock.now_ns() == 240 * TICK_NS
        assert 0.15 < stood_s < 0.26

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_ticks_that_agree_are_followed_ahead_as_a_replay_is_moved_on() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(NS, 1)
        for number in range(FollowedClock.FOLLOWED_AFTER):
            assert clock.now_ns() < 2 * NS
            clock.tick(60 * NS + number * TICK_NS, 1)
            await asyncio.sleep(1 / 120)
        assert (clock.now_ns(), clock.epoch) == (60 * NS + 3 * TICK_NS, 0)

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_when_the_very_first_tick_was_wrong_the_others_begin_time_anew() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(2**62, 1)
        for tick in range(3):
            clock.tick(5 * NS + tick * TICK_NS, 1)
            await asyncio.sleep(1 / 120)
        assert (clock.now_ns(), clock.epoch) == (5 * NS + 3 * TICK_NS, 1)

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_ticks_that_do_not_agree_are_never_followed() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(NS, 1)
        for wrong_s in (60, 20, 300, 10, 9, 8, 7):
            assert clock.tick(wrong_s * NS, 1)
            await asyncio.sleep(1 / 120)
        assert (clock.now_ns(), clock.epoch) == (NS + 30_000_000, 0)

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_who_was_stopped_for_a_while_takes_the_next_tick() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(NS, 1)
        await asyncio.sleep(10.0)
        assert clock.latest_ns() == NS + 2 * 10 * NS, "it may have gone twice as fast as it seemed"
        assert clock.tick(11 * NS, 1) == ""
        assert clock.now_ns() == 11 * NS

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_a_replay_at_a_hundred_times_real_time_is_followed() -> None:
    async def main() -> None:
        clock = FollowedClock()
        for tick in range(50):
            assert clock.tick(tick * 100 * TICK_NS, 1, rate=100.0) == ""
            await asyncio.sleep(1 / 120)

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_another_incarnation_is_a_new_epoch_wherever_its_time_stands() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(50 * NS, 1)
        await asyncio.sleep(0.01)
        clock.tick(0, 2)
        assert (clock.now_ns(), clock.epoch) == (0, 1)
        clock.tick(90 * NS, 3)
        assert (clock.now_ns(), clock.epoch) == (90 * NS, 2)
        clock.tick(91 * NS, 3)
        assert clock.epoch == 2

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_sleeping_follows_the_simulator_however_slow_it_is() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(0, 1, rate=0.1)
        waiting = await started(clock.sleep_until(1 * NS))
        for tick in range(1, 121):
            await asyncio.sleep(10 / 120)
            clock.tick(tick * NS // 120, 1, rate=0.1)
        assert await waiting
        assert loop_s() == pytest.approx(10.0, abs=0.1)
        assert clock.now_ns() >= NS

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_a_sleep_does_not_end_while_the_simulator_stands() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(0, 1)
        waiting = await started(clock.sleep_until(40_000_000))
        await asyncio.sleep(3600.0)
        assert not waiting.done()
        clock.tick(20_000_000, 1)
        assert await waiting
        assert clock.now_ns() >= 40_000_000

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_a_short_sleep_ends_between_ticks() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(0, 1)
        assert await clock.sleep_until(5_000_000)
        assert loop_s() == pytest.approx(0.005)

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_a_tick_that_says_time_is_faster_ends_a_sleep_early() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(0, 1, rate=0.01)
        waiting = await started(clock.sleep_until(20_000_000))
        await asyncio.sleep(0.1)
        clock.tick(25_000_000, 1, rate=1.0)
        assert await waiting
        assert loop_s() == pytest.approx(0.1)

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_a_long_sleep_is_not_woken_by_every_tick() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(0, 1)
        looked = 0
        now_ns = clock.now_ns

        def look() -> int:
            nonlocal looked
            looked += 1
            return now_ns()

        clock.now_ns = look  # type: ignore[method-assign]
        waiting = await started(clock.sleep_until(10 * NS))
        for tick in range(1, 1201):
            await asyncio.sleep(1 / 120)
            clock.tick(tick * NS // 120, 1)
        assert await waiting
        assert looked < 30
        assert loop_s() == pytest.approx(10.0, abs=0.02)

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize("deadline_ns", [10_000_000, 500_000_000])
def test_a_new_epoch_ends_a_sleep_and_says_so(deadline_ns: int) -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(0, 1)
        waiting = await started(clock.sleep_until(deadline_ns))
        clock.tick(0, 2)
        assert not await waiting

    run_virtual(main())


@pytest.mark.usefixtures("real_time")
def test_it_stands_when_its_ticks_have_ended_and_goes_on_with_the_next() -> None:
    async def main() -> None:
        clock = FollowedClock()
        clock.tick(5 * NS, incarnation=1)
        await asyncio.sleep(0.9)
        assert not clock.stands
        await asyncio.sleep(0.2)
        assert clock.stands
        clock.tick(1, incarnation=2)
        assert not clock.stands

    run_virtual(main())
