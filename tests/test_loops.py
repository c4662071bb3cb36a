"""Loops keep their rate and phase, and say when they could not."""

from __future__ import annotations

import asyncio

import pytest

from cocoro.clock import NS, Clock, FollowedClock, VirtualClock
from cocoro.health import LoopMeter
from cocoro.stepper import every
from cocoro.testing import JumpingClock, in_virtual_time
from cocoro.vloop import run_virtual


async def times_of(clock: Clock, rate_hz: float, count: int, meter: LoopMeter, work_s: dict[int, float]) -> list[float]:
    """The times at which a loop's turns begin; `work_s` has the durations of some of them."""
    begun: list[float] = []
    async for now_ns in every(clock, rate_hz, meter):
        begun.append(now_ns / NS)
        if len(begun) == count:
            break
        await asyncio.sleep(work_s.get(len(begun) - 1, 0.0))
    return begun


def turns(rate_hz: float, count: int, work_s: dict[int, float] | None = None) -> tuple[list[float], LoopMeter]:
    meter = LoopMeter("loop")
    return run_virtual(times_of(VirtualClock(), rate_hz, count, meter, work_s or {})), meter


def test_a_loop_begins_at_once_and_keeps_its_rate() -> None:
    begun, meter = turns(50.0, 5)
    assert begun == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08])
    assert meter.overruns == 0


def test_work_takes_nothing_from_the_rate() -> None:
    begun, meter = turns(50.0, 4, dict.fromkeys(range(4), 0.015))
    assert begun == pytest.approx([0.0, 0.02, 0.04, 0.06])
    assert meter.overruns == 0


def test_a_turn_that_is_a_little_late_is_followed_by_one_in_time() -> None:
    begun, meter = turns(50.0, 4, {1: 0.03})
    assert begun == pytest.approx([0.0, 0.02, 0.05, 0.06])
    assert meter.overruns == 0


def test_missed_turns_are_left_out_and_counted_and_the_phase_is_kept() -> None:
    begun, meter = turns(50.0, 5, {1: 0.075})
    assert begun == pytest.approx([0.0, 0.02, 0.095, 0.1, 0.12])
    assert meter.overruns == 2


@pytest.mark.parametrize("rate_hz", [0.0, -1.0])
def test_a_rate_is_positive(rate_hz: float) -> None:
    with pytest.raises(ValueError, match="rate_hz must be positive"):
        turns(rate_hz, 1)


@pytest.mark.parametrize("restart_at_s", [0.0, 2.5])
def test_when_the_clock_begins_anew_so_does_the_loop_without_a_pause(restart_at_s: float) -> None:
    @in_virtual_time
    async def scenario() -> None:
        clock, meter, begun = JumpingClock(), LoopMeter("loop"), []
        clock.jump_to(1000.0)
        asyncio.get_running_loop().call_later(0.05, clock.jump_to, restart_at_s)
        async for now_ns in every(clock, 50.0, meter):
            begun.append(round(now_ns / NS - restart_at_s, 3))
            if len(begun) == 6:
                break
        assert begun[3:] == [0.0, 0.02, 0.04]
        assert meter.overruns == 0

    scenario()


def test_a_loop_that_waits_for_the_simulators_clock_has_missed_nothing() -> None:
    async def scenario() -> None:
        clock, meter = FollowedClock(), LoopMeter("loop")
        loop = every(clock, 50.0, meter)
        first = asyncio.ensure_future(anext(loop))
        await asyncio.sleep(0)
        assert not first.done()
        clock.tick(1000 * NS, incarnation=1)
        assert await first >= 1000 * NS
        second = asyncio.ensure_future(anext(loop))
        await asyncio.sleep(0)
        clock.tick(1000 * NS + NS // 10, incarnation=1)
        assert await second >= 1000 * NS + NS // 50
        assert meter.overruns == 0

    asyncio.run(scenario())


def test_a_meter_tells_of_the_time_since_it_was_last_asked() -> None:
    _, meter = turns(50.0, 101, {50: 0.03})
    meter.steps_ms.extend([1.0, 2.0, 9.0])
    health = meter.health()
    assert health.period_median_ms == pytest.approx(20.0)
    assert health.period_p99_ms == pytest.approx(20.1, abs=0.2)
    assert health.rate_hz == pytest.approx(50.0)
    assert health.step_median_ms == 2.0
    again = meter.health()
    assert (again.rate_hz, again.period_median_ms, again.step_median_ms) == (0.0, 0.0, 0.0)


def test_a_clock_that_jumped_back_gives_no_period() -> None:
    meter = LoopMeter("loop")
    for now_s in (999.0, 999.5, 0.0, 0.5):
        meter.began(round(now_s * NS))
    assert list(meter.periods_ms) == [500.0, 500.0]
