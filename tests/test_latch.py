"""The emergency stop's latch, as a hardware service keeps it."""

from __future__ import annotations

import asyncio

import pytest

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import NS, VirtualClock
from cocoro.latch import ServiceLatch
from cocoro.messages import EstopReply, EstopRequest, Latch, LatchState, ResetRequest
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.testing import JumpingClock, in_virtual_time, settle

ROBOT = Robot.load()


class Base:
    """A base service with its latch, an executive and an operator."""

    def __init__(self, clock: VirtualClock | None = None) -> None:
        self.mesh, self.clock = LocalMesh(), clock or VirtualClock()
        self.executive, self.operator = (
            Node(name, self.mesh.join(), self.clock, ROBOT) for name in ("executive", "op")
        )
        self.node: Node | None = None
        self.changes: list[tuple[LatchState, str]] = []

    async def __aenter__(self) -> Base:
        await self.restart()
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self.node is not None
        await self.node.__aexit__()

    async def restart(self) -> None:
        """The hardware service ends, if it ran, and starts afresh."""
        if self.node is not None:
            await self.node.__aexit__()
        self.node = Node("base", self.mesh.join(), self.clock, ROBOT)
        await self.node.__aenter__()
        self.latch = ServiceLatch(self.node, lambda state, by: self.changes.append((state, by)))

    async def publish(self, state: LatchState, stamp_ns: int | None = None) -> LatchState:
        """Publishes the latch as the executive does; returns the state of the base's latch."""
        self.executive.publish(topics.LATCH, Latch(state=state, by="executive"), stamp_ns)
        await settle()
        return self.latch.state

    async def ask(self, latched: bool) -> EstopReply:
        if latched:
            return await self.operator.call(topics.ESTOP.of("base"), EstopRequest(by="operator"))
        return await self.operator.call(topics.RESET.of("base"), ResetRequest(by="operator"))


@in_virtual_time
async def test_it_comes_up_unknown_and_stays_so_until_someone_knows() -> None:
    async with Base() as base:
        await asyncio.sleep(60.0)
        assert base.latch.state == "unknown"
        assert await base.publish("unknown") == "unknown"
        assert base.changes == []
        assert await base.publish("released") == "released"
        assert base.changes == [("released", "executive")]


@in_virtual_time
async def test_an_operators_stop_is_in_force_before_it_is_acknowledged() -> None:
    async with Base() as base:
        await base.publish("released")
        reply = await base.ask(latched=True)
        assert reply == EstopReply(service="base", latch="latched")
        assert base.changes[-1] == ("latched", "operator")


@in_virtual_time
async def test_what_is_latched_is_released_by_an_operator_and_by_nobody_else() -> None:
    async with Base() as base:
        await base.ask(latched=True)
        await asyncio.sleep(10.0)
        assert await base.publish("released") == "latched"
        assert await base.publish("unknown") == "latched"
        assert (await base.ask(latched=False)).latch == "released"
        assert base.latch.state == "released"


@in_virtual_time
async def test_an_operator_can_release_what_knows_of_no_latch() -> None:
    async with Base() as base:
        assert (await base.ask(latched=False)).latch == "released"


@in_virtual_time
async def test_the_executives_word_latches() -> None:
    async with Base() as base:
        await base.publish("released")
        assert await base.publish("latched") == "latched"


@pytest.mark.parametrize(("after_s", "state"), [(0.0, "released"), (0.49, "released"), (0.51, "latched")])
def test_a_word_from_before_a_reset_does_not_undo_it(after_s: float, state: LatchState) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with Base() as base:
            await base.ask(latched=True)
            await base.ask(latched=False)
            await asyncio.sleep(after_s)
            assert await base.publish("latched") == state

    scenario()


@in_virtual_time
async def test_an_operators_stop_counts_at_once_after_a_reset() -> None:
    async with Base() as base:
        await base.ask(latched=False)
        assert (await base.ask(latched=True)).latch == "latched"


@in_virtual_time
async def test_a_restarted_service_is_stopped_and_stays_so_while_the_stop_is_latched() -> None:
    async with Base() as base:
        await base.ask(latched=True)
        await base.restart()
        assert base.latch.state == "unknown"
        assert await base.publish("latched") == "latched"
        assert await base.publish("released") == "latched"


@in_virtual_time
async def test_a_restarted_service_goes_on_when_nothing_is_latched() -> None:
    async with Base() as base:
        await base.publish("released")
        await base.restart()
        assert base.latch.state == "unknown"
        assert await base.publish("released") == "released"


@in_virtual_time
async def test_an_old_word_is_none() -> None:
    async with Base() as base:
        await asyncio.sleep(10.0)
        assert await base.publish("released", stamp_ns=round(7.9 * NS)) == "unknown"
        assert await base.publish("released", stamp_ns=round(8.1 * NS)) == "released"


@in_virtual_time
async def test_a_word_counts_again_when_the_clock_has_begun_anew_after_a_reset() -> None:
    clock = JumpingClock()
    clock.jump_to(1000.0)
    async with Base(clock) as base:
        await base.ask(latched=False)
        clock.jump_to(1.0)
        assert await base.publish("latched") == "latched"
