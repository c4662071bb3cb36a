"""The harness for components, with a small component."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from typing import Any

import msgspec
import pytest
from spelled import idle

from cocoro import topics
from cocoro.component import Implementation
from cocoro.core import Output, Sample, Schedule, Take
from cocoro.errors import CocoroError
from cocoro.messages import BaseCommand, CancelRequest, Message, PlannerStatus, TaskReply
from cocoro.node import Node
from cocoro.testing import CoreUnderTest, JumpingClock, ServiceUnderTest, execute_again, in_virtual_time, settle
from cocoro.topics import STEPS, Topic
from cocoro.vloop import VirtualTimeLoop

_luck = count()


class Answer:
    """A core that answers each intent with a status, and counts them."""

    def __init__(self, honest: bool = True) -> None:
        self.heard = 0
        self._honest = honest

    reads: Mapping[Topic[Any], Take] = {topics.INTENT: "all"}
    schedule = Schedule(10.0, (topics.INTENT,))

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        self.heard += len(inputs)
        why = str(self.heard if self._honest else next(_luck))
        return [Output(topics.PLAN, PlannerStatus(step=self.heard, why=why)) for _ in inputs]


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    honest: bool = True
    ends: bool = False


async def run(node: Node, config: Config) -> None:
    async def cancel(request: CancelRequest) -> TaskReply:
        return TaskReply(accepted=True, task_id=request.task_id)

    node.serve(topics.CANCEL, cancel)
    if not config.ends:
        await node.drive(Answer(config.honest))


ANSWERER = Implementation(Config, run)


@in_virtual_time
async def test_what_is_fed_is_answered_and_what_was_fed_is_no_answer() -> None:
    async with ServiceUnderTest(ANSWERER, name="answerer") as service:
        assert service.alive
        assert service.running
        service.feed(topics.INTENT, idle())
        service.feed(topics.PLAN, PlannerStatus(why="the test's own"))
        await service.advance(0.05)
        assert [status.why for status in service.outputs(topics.PLAN)] == ["1"]
        assert service.latest(topics.PLAN).stamp_ns == 0
        service.forget()
        with pytest.raises(AssertionError, match="answerer has published nothing on planning/status"):
            service.latest(topics.PLAN)


@in_virtual_time
async def test_time_passes_as_it_is_told_to() -> None:
    async with ServiceUnderTest(ANSWERER, name="answerer") as service:
        await service.advance(2.5)
        assert service.node.now_ns() == 2_500_000_000
        with pytest.raises(AssertionError, match="still not so after 3 s"):
            await service.until(lambda: False, timeout_s=3.0)


@in_virtual_time
async def test_settling_runs_all_that_is_due_now_and_takes_no_turns_after_that() -> None:
    loop, seen = asyncio.get_running_loop(), list[object]()
    assert isinstance(loop, VirtualTimeLoop)

    async def chain() -> None:
        for link in range(20):
            await asyncio.sleep(0)
            seen.append(link)
        loop.call_at(loop.time(), seen.append, "timer")

    chained = asyncio.ensure_future(chain())
    later = loop.call_later(0.001, seen.append, "later")
    await settle()
    assert seen == [*range(20), "timer"]
    assert chained.done()
    turns: list[None] = []

    run_once: Callable[[], None] = loop._run_once  # type: ignore[attr-defined]

    def counted() -> None:
        turns.append(None)
        run_once()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "_run_once", counted)
        await settle()
    assert 1 <= len(turns) <= 2
    assert loop.time() == 0.0
    later.cancel()


@in_virtual_time
async def test_bad_input_is_counted_by_the_service() -> None:
    async with ServiceUnderTest(ANSWERER, name="answerer") as service:
        service.feed_raw(topics.INTENT, b"\xc1")
        service.feed(topics.INTENT, idle())
        await service.settle()
        received = service.received(topics.INTENT)
        assert (received.count, received.rejected) == (1, 1)


@in_virtual_time
async def test_it_can_be_asked_and_killed() -> None:
    async with ServiceUnderTest(ANSWERER, name="answerer") as service:
        assert (await service.ask(topics.CANCEL, CancelRequest(task_id="t"))).task_id == "t"
        await service.kill()
        assert not service.alive
        assert not service.running
        with pytest.raises(CocoroError, match="nobody answers"):
            await service.ask(topics.CANCEL, CancelRequest())


@in_virtual_time
async def test_a_component_that_ends_by_itself_is_noticed() -> None:
    with pytest.raises(AssertionError, match="answerer ended by itself"):
        async with ServiceUnderTest(ANSWERER, {"ends": True}, name="answerer"):
            pass


@in_virtual_time
async def test_a_component_is_found_by_its_modules_name_and_its_settings_are_checked() -> None:
    async with ServiceUnderTest("services.planning.service", {"rate_hz": 25.0}) as service:
        assert service.name == "planning"
        await service.advance(1.0)
        assert len(service.outputs(topics.PLAN)) == pytest.approx(25, abs=1)
    with pytest.raises(msgspec.ValidationError, match="rate"):
        ServiceUnderTest("services.planning.service", {"rate": 25.0})


def test_a_core_by_hand_gets_what_it_reads_and_nothing_else() -> None:
    core = CoreUnderTest(Answer())
    core.feed(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.0, turn_radps=0.0))
    assert core.step() == []
    for _ in range(2):
        core.feed(topics.INTENT, idle())
    assert [output.topic for output in core.step(after_s=0.1)] == [topics.PLAN, topics.PLAN]
    assert [status.step for status in core.outputs(topics.PLAN)] == [2, 2]
    assert core.now_ns == 1_100_000_000


async def recorded(config: Mapping[str, Any]) -> tuple[list[Any], dict[tuple[str, int, int], Message]]:
    """Steps of the component, and all that travelled meanwhile."""
    async with ServiceUnderTest(ANSWERER, config, name="answerer", record_steps=True) as service:
        for _ in range(5):
            service.feed(topics.INTENT, idle())
            await service.advance(0.03)
        return service.outputs(STEPS.of("answerer")), service.tap.samples()


@in_virtual_time
async def test_a_core_that_depends_on_its_inputs_alone_gives_the_same_again() -> None:
    records, samples = await recorded({})
    executed = execute_again(Answer(), records, samples)
    assert len(executed) == 5
    assert all(step.again == step.recorded for step in executed)


@in_virtual_time
async def test_a_core_that_depends_on_anything_else_is_found_out() -> None:
    records, samples = await recorded({"honest": False})
    executed = execute_again(Answer(honest=False), records, samples)
    assert any(step.again != step.recorded for step in executed)


@in_virtual_time
async def test_a_record_with_something_missing_is_no_record() -> None:
    records, samples = await recorded({})
    with pytest.raises(CocoroError, match=r"consumed or gave .*executive/intent.* which was not recorded"):
        execute_again(Answer(), records, {key: m for key, m in samples.items() if key[0] != "executive/intent"})


@in_virtual_time
async def test_a_clock_jumps_as_it_is_told_to() -> None:
    clock = JumpingClock()
    async with ServiceUnderTest(ANSWERER, name="answerer", clock=clock) as service:
        clock.jump_to(100.0)
        assert (clock.now_ns(), clock.epoch) == (100_000_000_000, 0)
        clock.jump_to(1.0)
        assert (clock.now_ns(), clock.epoch) == (1_000_000_000, 1)
        await service.advance(1.0)
        assert clock.now_ns() == 2_000_000_000
