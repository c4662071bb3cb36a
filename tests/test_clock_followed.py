"""The clock that follows the simulator's: its ticks, its epochs, and waiting for its time."""

from __future__ import annotations

import asyncio

import pytest
from clock_rig import loop_s, started

from cocoro.clock import NS, FollowedClock
from cocoro.vloop import run_virtual


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
@pytest.mark.parametrize("ahead_s", [0.13, 0.25, 1.0, 3600.0, 2.0**62 / NS])
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
                assert clock.tick(tick * TICK_NS + NS // 10, 1) == ""
            clock.tick(tick * TICK_NS, 1)
            before_ns = clock.now_ns()
            await asyncio.sleep(1 / 120)
            stood_s += (1 / 120) * (clock.now_ns() == before_ns)
        assert clock.epoch == 0
        assert clock.now_ns() == 240 * TICK_NS
        assert 0.05 < stood_s < 0.11

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
def test_ticks_that_come_in_a_burst_may_lack_some_in_the_middle() -> None:
    async def main() -> None:
        clock = FollowedClock()
        for tick in range(120):
            clock.tick(tick * TICK_NS, 1)
            await asyncio.sleep(1 / 120)
        await asyncio.sleep(1.0)
        for tick in (120, 121, 180, 239):
            assert clock.tick(tick * TICK_NS, 1) == ""
        assert clock.tick(263 * TICK_NS, 1), "all that were late have come"

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
        stands: list[bool] = []
        await asyncio.sleep(0.9)
        stands.append(clock.stands)
        await asyncio.sleep(0.2)
        stands.append(clock.stands)
        clock.tick(1, incarnation=2)
        stands.append(clock.stands)
        assert stands == [False, True, False]

    run_virtual(main())
