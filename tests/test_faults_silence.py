"""Parts that live and say nothing: hung, stopped, starved. In virtual time, so that every bound is exact.

Policies: docs/faults.md.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from robot_rig import HALTED_MPS, SMALL_FRAMES, RobotRig

from cocoro import topics
from cocoro.bus.base import Payload
from cocoro.testing import in_virtual_time
from services.planning.floor_map import FloorMap

pytestmark = pytest.mark.sim

ZERO_S = 0.2
"""Bound from the fault until only zero is commanded."""
STAND_S = 0.3
"""Bound from the fault until the body stands, by the true state."""
REAL = {"sim": SMALL_FRAMES | {"frame_rate_hz": 30.0, "sensors": "real"}}
PERIOD_S = 1 / 30
DRIVING_MPS = 0.25
BLIND = "standing still: nothing from perception for"


class Mute:
    """Replaces a publisher and sends nothing."""

    trouble = ""

    def put(self, payload: Payload) -> None:
        pass

    def close(self) -> None:
        pass


@contextmanager
def silent(rig: RobotRig, service: str) -> Iterator[None]:
    """Nothing that the service publishes gets out meanwhile, though its process lives."""
    publishers = list(rig._services[service].node._publishers.values())
    raws = [publisher._raw for publisher in publishers]
    for publisher in publishers:
        publisher._raw = Mute()
    yield
    for publisher, raw in zip(publishers, raws, strict=True):
        publisher._raw = raw


def stands_in_time(rig: RobotRig, fault_s: float) -> None:
    assert not any(any(wheels) for wheels in rig.commanded_since(fault_s + ZERO_S))
    assert rig.commanded_since(fault_s + ZERO_S) or not rig.base_obeys_since(fault_s + ZERO_S)
    assert max(rig.speeds_since(fault_s + STAND_S)) < HALTED_MPS


def whys_since(rig: RobotRig, when_s: float) -> set[str]:
    return {status.why for status in rig.tap.messages(topics.PLAN) if status.stamp_ns > when_s * 1e9}


@pytest.mark.parametrize("service", ["planning", "perception", "executive"])
def test_who_falls_silent_while_driving_leaves_a_robot_that_stands(service: str) -> None:
    """While it speeds up, between two frames; at full speed: test_faults_speed."""

    @in_virtual_time
    async def scenario() -> None:
        async with RobotRig(settings=REAL) as rig:
            await rig.driving(0.15)
            await rig.advance(PERIOD_S / 3)
            silent_s = rig.now_s
            with silent(rig, service):
                await rig.advance(1.0)
            stands_in_time(rig, silent_s)

    scenario()


@in_virtual_time
async def test_a_fetch_goes_on_when_those_who_were_silent_speak_again_and_the_hand_drops_nothing() -> None:
    async with RobotRig() as rig:
        task_id = await rig.driving()
        silent_s = rig.now_s
        with silent(rig, "perception"):
            await rig.advance(1.0)
            assert rig.speed_mps < HALTED_MPS
            assert rig.tap.messages(topics.PLAN)[-1].why == f"{BLIND} 1.0 s"
        await rig.until(lambda: rig.speed_mps > DRIVING_MPS)
        assert not any(why.startswith(BLIND) for why in whys_since(rig, silent_s + 1.2))
        with silent(rig, "executive"):
            await rig.advance(1.0)
            assert rig.speed_mps < HALTED_MPS
        assert (await rig.outcome(task_id)).outcome == "done"
        for service in ("planning", "perception", "executive"):
            with silent(rig, service):
                await asyncio.sleep(2.0)
            assert rig.held("red_can")
        await rig.advance(0.5)
        assert (await rig.run("put-down")).outcome == "done"


@in_virtual_time
async def test_a_lost_frame_stops_nothing() -> None:
    async with RobotRig(settings=REAL) as rig:
        await rig.driving()
        since_s = rig.now_s
        for _ in range(4):
            with silent(rig, "perception"):
                await rig.advance(PERIOD_S)
            await rig.advance(0.2)
        assert not any(why.startswith(BLIND) for why in whys_since(rig, since_s))


@in_virtual_time
async def test_perception_that_is_slow_is_not_taken_for_silent() -> None:
    async with RobotRig(latency_s={"perception": 0.5}) as rig:
        state = await rig.run("fetch", "red_can")
        assert (state.outcome, state.reason) == ("done", "")
        approach = next(phase for phase in state.phases if phase.name == "approach")
        since_s = approach.start_ns / 1e9
        assert not any(why.startswith(BLIND) for why in whys_since(rig, since_s))


@in_virtual_time
async def test_slow_perception_that_falls_silent_is_noticed_after_two_of_its_own_periods() -> None:
    async with RobotRig(latency_s={"perception": 0.5}) as rig:
        await rig.driving(0.2)
        silent_s = rig.now_s
        with silent(rig, "perception"):
            await rig.advance(2.0)
        late_s = 2 * 0.5
        stands_in_time(rig, silent_s + late_s)


@in_virtual_time
async def test_when_perception_stays_silent_the_task_fails_and_says_so() -> None:
    async with RobotRig() as rig:
        task_id = await rig.driving()
        with silent(rig, "perception"):
            state = await rig.outcome(task_id, timeout_s=8.0)
            assert (state.outcome, state.reason) == ("failed", f"stale: {BLIND} 5.2 s")
            # Nothing is searched for with closed eyes either.
            state = await rig.run("fetch", "green_can")
            assert (state.outcome, state.reason[: len(BLIND) + 7]) == ("failed", f"stale: {BLIND}")
            assert state.elapsed_s < 1.0
        await rig.advance(0.2)
        await rig.driving()


@in_virtual_time
async def test_when_the_planner_stays_silent_the_task_fails_and_says_so() -> None:
    async with RobotRig(settings={"executive": {"planner_silence_s": 1.0}}) as rig:
        task_id = await rig.driving()
        with silent(rig, "planning"):
            state = await rig.outcome(task_id, timeout_s=5.0)
            assert (state.outcome, state.reason) == ("failed", "not_alive: nothing from the planner for 1 s")
            refused = await rig.ask("fetch", "red_can")
            assert (refused.refusal, refused.text) == ("not_alive", "the planner says nothing; see cocoro status")
        await rig.advance(0.2)
        await rig.driving()


def test_an_arm_that_no_command_reaches_is_not_held_up_by_anything(monkeypatch: pytest.MonkeyPatch) -> None:
    touched: list[object] = []
    monkeypatch.setattr(FloorMap, "bump", lambda _, places, height_m=None: touched.append(places))

    @in_virtual_time
    async def scenario() -> None:
        async with RobotRig() as rig:
            await rig.driving(0.1)
            with silent(rig, "planning"):  # which begins to unfold the arm meanwhile
                await rig.advance(2.5)
            await rig.advance(0.5)
            assert rig.speed_mps > 0.1

    scenario()
    assert touched == []
