"""A core that a node drives: when it is stepped, what becomes of its outputs, and the record of its steps."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from typing import Any

import pytest
from node_rig import Mesh, state

from cocoro import topics
from cocoro.clock import NS, Clock
from cocoro.core import Output, Sample, Schedule, Take
from cocoro.messages import BaseCommand, Detections, StepRecord
from cocoro.node import RECORDER_S
from cocoro.testing import JumpingClock, in_virtual_time, settle
from cocoro.topics import Topic

MS = NS // 1000


def seen(stamp_ns: int = 0) -> Detections:
    return Detections(stamp_ns=stamp_ns, frame_seq=0, frame_incarnation=0, width=1, height=1)


# --- driving a core -------------------------------------------------------------------------------


class Echo:
    """A core that remembers its steps and answers each detection with a command."""

    def __init__(self, rate_hz: float | None = 50.0, triggers: tuple[Topic[Any], ...] = (topics.DETECTIONS,)) -> None:
        self.steps: list[tuple[int, list[tuple[str, int]]]] = []
        self._schedule = Schedule(rate_hz, triggers)
        self.raises: Exception | None = None

    @property
    def reads(self) -> Mapping[Topic[Any], Take]:
        return {topics.DETECTIONS: "all", topics.BASE_STATE: "latest"}

    @property
    def schedule(self) -> Schedule:
        return self._schedule

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        if self.raises is not None:
            raise self.raises
        self.steps.append((now_ns, [(sample.topic.name, sample.message.seq) for sample in inputs]))
        commands = [
            BaseCommand(ahead_mps=0.1, turn_radps=0.0) for sample in inputs if isinstance(sample.message, Detections)
        ]
        return [Output(topics.BASE_COMMAND, command) for command in commands]

    @property
    def times_ms(self) -> list[int]:
        return [now_ns // MS for now_ns, _ in self.steps]


class Driven:
    """A node that drives an echo, and one that feeds it."""

    def __init__(self, core: Echo | None = None, clock: Clock | None = None, **options: Any) -> None:
        self.core = core or Echo()
        self.mesh = Mesh(clock)
        self.node = self.mesh.node("planning", **options)
        self.feeder = self.mesh.node("feeder")
        self.tap = self.mesh.tap()

    async def __aenter__(self) -> Driven:
        await self.feeder.__aenter__()
        await self.node.__aenter__()
        self.driving = asyncio.create_task(self.node.drive(self.core))
        return self

    async def __aexit__(self, *_: object) -> None:
        self.driving.cancel()
        await asyncio.gather(self.driving, return_exceptions=True)
        await self.node.__aexit__()
        await self.feeder.__aexit__()

    def commands(self) -> list[BaseCommand]:
        return self.tap.messages(topics.BASE_COMMAND)


@in_virtual_time
async def test_a_core_is_stepped_at_its_rate_and_at_once_when_a_trigger_comes() -> None:
    async with Driven() as driven:
        await asyncio.sleep(0.030)
        driven.feeder.publish(topics.DETECTIONS, seen())
        await asyncio.sleep(0.045)
        assert driven.core.times_ms == [0, 20, 30, 50, 70]


@in_virtual_time
async def test_what_is_no_trigger_waits_for_the_next_step() -> None:
    async with Driven() as driven:
        await asyncio.sleep(0.025)
        driven.feeder.publish(topics.BASE_STATE, state())
        driven.feeder.publish(topics.BASE_STATE, state())
        await asyncio.sleep(0.030)
        assert driven.core.steps[2] == (40 * MS, [("base/state", 1)])


@in_virtual_time
async def test_a_core_without_a_rate_is_stepped_by_its_triggers_alone() -> None:
    async with Driven(Echo(rate_hz=None)) as driven:
        await asyncio.sleep(10.0)
        assert driven.core.steps == []
        for _ in range(3):
            driven.feeder.publish(topics.DETECTIONS, seen())
        await settle()
        assert [inputs for _, inputs in driven.core.steps] == [[("perception/detections", seq) for seq in range(3)]]


@in_virtual_time
async def test_no_trigger_is_lost_while_a_step_takes_its_time() -> None:
    async with Driven(Echo(rate_hz=None), latency_s=0.1) as driven:
        for number in range(20):
            await asyncio.sleep(0.03 * (number % 5))
            driven.feeder.publish(topics.DETECTIONS, seen())
        await asyncio.sleep(1.0)
        assert [seq for _, inputs in driven.core.steps for _, seq in inputs] == list(range(20))
        assert len(driven.commands()) == 20


@in_virtual_time
async def test_latency_makes_outputs_late_and_says_so_in_their_stamp() -> None:
    async with Driven(latency_s=0.1) as driven:
        await asyncio.sleep(0.010)
        driven.feeder.publish(topics.DETECTIONS, seen())
        await asyncio.sleep(0.099)
        assert driven.commands() == []
        await asyncio.sleep(0.002)
        assert [command.stamp_ns for command in driven.commands()] == [110 * MS]


@in_virtual_time
async def test_a_core_that_fails_ends_its_service() -> None:
    driven = Driven()
    driven.core.raises = ZeroDivisionError("of the core's own")
    async with driven:
        with pytest.raises(ZeroDivisionError, match="of the core's own"):
            await driven.driving


@in_virtual_time
async def test_when_the_clock_begins_anew_a_core_is_stepped_at_once_and_at_its_rate_from_then_on() -> None:
    clock = JumpingClock()
    clock.jump_to(1000.0)
    async with Driven(clock=clock) as driven:
        await asyncio.sleep(0.05)
        clock.jump_to(3.0)
        await asyncio.sleep(0.05)
        assert driven.core.times_ms == [1_000_000, 1_000_020, 1_000_040, 3_000, 3_020, 3_040]


@in_virtual_time
async def test_what_was_computed_before_the_clock_began_anew_is_not_said_after_it() -> None:
    clock = JumpingClock()
    clock.jump_to(1000.0)
    async with Driven(clock=clock, latency_s=0.1) as driven:
        await asyncio.sleep(0.005)
        driven.feeder.publish(topics.DETECTIONS, seen())
        await asyncio.sleep(0.05)
        clock.jump_to(3.0)
        await asyncio.sleep(0.5)
        assert driven.commands() == []
        after = [now_ms for now_ms in driven.core.times_ms if now_ms < 1_000_000]
        assert after[:3] == [3_000, 3_020, 3_040]


@in_virtual_time
async def test_a_core_that_is_too_slow_for_its_rate_leaves_others_their_turn() -> None:
    clock = JumpingClock()

    class Slow(Echo):
        def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
            clock.jump_to(now_ns / NS + 0.030)
            return super().step(inputs, now_ns)

    async with Driven(Slow(), clock=clock) as driven:
        turns = 0
        while len(driven.core.steps) < 10:
            await asyncio.sleep(0)
            turns += 1
            assert turns < 1000
        driven.feeder.publish(topics.DETECTIONS, seen())
        await settle()
        assert driven.commands()


@in_virtual_time
async def test_driving_that_is_cancelled_leaves_no_task_behind() -> None:
    before = asyncio.all_tasks()
    async with Driven() as driven:
        await asyncio.sleep(0.033)
        assert not driven.driving.done()
    await settle()
    assert asyncio.all_tasks() == before


# --- the record of steps --------------------------------------------------------------------------


@in_virtual_time
async def test_a_record_says_what_a_step_consumed_and_gave_in_order() -> None:
    async with Driven(Echo(rate_hz=None), record_steps=True) as driven:
        await asyncio.sleep(RECORDER_S + 1.0)  # it waits for a recorder first, and there is none
        now_ns = driven.node.now_ns()
        for _ in range(2):
            driven.feeder.publish(topics.BASE_STATE, state())
            driven.feeder.publish(topics.DETECTIONS, seen())
        await settle()
        (record,) = driven.tap.messages(topics.STEPS.of("planning"))
        states = driven.feeder.publisher(topics.BASE_STATE).incarnation
        detections = driven.feeder.publisher(topics.DETECTIONS).incarnation
        commands = driven.node.publisher(topics.BASE_COMMAND).incarnation
        assert record == StepRecord(
            stamp_ns=now_ns,
            seq=0,
            incarnation=record.incarnation,
            now_ns=now_ns,
            core="planning",
            consumed=(
                ("base/state", states, 1),
                ("perception/detections", detections, 0),
                ("perception/detections", detections, 1),
            ),
            produced=(("base/command", commands, 0), ("base/command", commands, 1)),
        )


@in_virtual_time
async def test_steps_are_recorded_only_when_that_is_asked_for() -> None:
    async with Driven() as driven:
        await asyncio.sleep(1.0)
        assert driven.tap.messages(topics.STEPS.of("planning")) == []
