"""The latch of a service in a separate process: the stop path halts it, and its record outlives it."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from apps.cli.estop_mesh import ROUND_S
from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import RealClock
from cocoro.latch import ServiceLatch
from cocoro.messages import EstopReply, EstopRequest, Latch, LatchState, ResetRequest
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.stop.asking import Asking
from cocoro.stop.record import prepare, read

ROBOT = Robot.load()
PATIENCE_S = 60.0


class Base:
    """A base service with its latch, and an operator. Make it with `base`."""

    def __init__(self, folder: Path, node: Node, operator: Node) -> None:
        self.folder = folder
        self.node = node
        self.operator = operator
        self.changes: list[tuple[LatchState, str]] = []
        self.halts = 0
        self._news = asyncio.Event()
        self.latch = ServiceLatch(node, self.changed, self.halt)

    def changed(self, state: LatchState, by: str) -> None:
        self.changes.append((state, by))
        self._news.set()

    def halt(self) -> None:
        self.halts += 1

    def stop(self, within_s: float = PATIENCE_S) -> Asking:
        """Stop by the stop path. It blocks, as if this were another process."""
        with Asking(self.node.robot_name) as asking:
            asking.go_on(time.monotonic() + within_s)
            asking.hear_of_the_disk(time.monotonic() + within_s)
        return asking

    async def ask(self, latched: bool) -> EstopReply:
        if latched:
            return await self.operator.call(topics.ESTOP.of("base"), EstopRequest(by="operator"))
        return await self.operator.call(topics.RESET.of("base"), ResetRequest(by="operator"))

    async def latched(self) -> None:
        """Wait until it is."""
        async with asyncio.timeout(PATIENCE_S):
            while self.latch.state != "latched":
                self._news.clear()
                await self._news.wait()

    async def kept(self) -> None:
        """Wait until the disk has what was set last."""
        assert self.latch._record is not None
        assert await asyncio.wrap_future(self.latch._record.last) == ""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    prepare(tmp_path / "latch", ["base"], by_hand=True)
    return tmp_path / "latch"


@asynccontextmanager
async def base(folder: Path) -> AsyncIterator[Base]:
    mesh, clock, name = LocalMesh(), RealClock(), f"robot-{os.urandom(4).hex()}"
    async with (
        Node("base", mesh.join(), clock, ROBOT, robot_name=name, latches=folder) as node,
        Node("operator", mesh.join(), clock, ROBOT, robot_name=name) as operator,
    ):
        yield Base(folder, node, operator)


def test_the_stop_path_latches_and_the_latch_is_on_the_disk_when_it_says_so(folder: Path) -> None:
    async def scenario() -> None:
        async with base(folder) as it:
            await it.ask(latched=False)
            asking = await asyncio.to_thread(it.stop)
            (point,) = asking.points.values()
            assert (point.service, point.kept) == ("base", True)
            assert it.halts == 1
            assert read(folder / "base").latched
            await it.latched()
            assert it.changes[-1] == ("latched", f"operator (user {os.getuid()}, pid {os.getpid()})")

    asyncio.run(scenario())


def test_a_loop_that_hangs_keeps_nothing_from_being_halted_and_kept(folder: Path) -> None:
    async def scenario() -> None:
        async with base(folder) as it:
            await it.ask(latched=False)
            (point,) = it.stop().points.values()  # in the loop itself, so it does nothing else
            assert point.latched_ns
            assert point.kept
            assert it.halts == 1
            assert it.latch.state == "released"
            await it.latched()

    asyncio.run(scenario())


def test_what_died_latched_comes_up_latched_and_is_released_by_the_owner_only(folder: Path) -> None:
    async def scenario() -> None:
        async with base(folder) as it:
            await it.ask(latched=False)
            it.stop()
        async with base(folder) as it:
            assert it.latch.state == "latched"
            assert it.changes[0][1].startswith(f"operator (user {os.getuid()}, pid {os.getpid()}), 20")
            it.latch.follow("released", "executive")
            assert it.latch.state == "latched"
            assert await it.ask(latched=False) == EstopReply(service="base", latch="released")
        async with base(folder) as it:
            assert it.latch.state == "unknown", "it still waits for the executive's report"

    asyncio.run(scenario())


@pytest.mark.parametrize("way", ["request", "word"])
def test_a_latch_that_came_by_the_mesh_is_kept_too(folder: Path, way: str) -> None:
    async def scenario() -> None:
        async with base(folder) as it:
            await it.ask(latched=False)
            if way == "request":
                assert await it.ask(latched=True) == EstopReply(service="base", latch="latched")
            else:
                await asyncio.sleep(0.6)  # a word that soon after a reset may be from before it
                it.operator.publish(topics.LATCH, Latch(state="latched", by="executive"))
            await it.latched()
            await it.kept()
            assert read(folder / "base").latched

    asyncio.run(scenario())


def test_a_record_that_cannot_be_read_is_a_latch_that_says_why(folder: Path) -> None:
    (folder / "base").write_bytes(b"?")

    async def scenario() -> None:
        async with base(folder) as it:
            assert it.latch.state == "latched"
            assert it.changes == [("latched", f"the record {folder}/base, which cannot be read: it is damaged")]

    asyncio.run(scenario())


def test_a_disk_that_does_not_take_it_is_told_and_holds_nothing_up(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    async def scenario() -> None:
        async with base(folder) as it:
            await it.ask(latched=False)
            monkeypatch.setattr(os, "pwrite", full)
            (point,) = it.stop().points.values()
            assert point.latched_ns
            assert (point.kept, point.why_not_kept) == (False, f"{folder}/base: No space left on device")
            reply = await it.ask(latched=True)
            assert reply.latch == "latched"
            assert "restart" in reply.text
            assert f"{folder}/base: No space left on device" in reply.text

    asyncio.run(scenario())


def test_who_has_ended_hears_no_stop(folder: Path) -> None:
    async def scenario() -> None:
        async with base(folder) as it:
            name = it.node.robot_name
        with Asking(name) as asking:
            assert not asking.waiting

    asyncio.run(scenario())


def test_however_many_stops_come_a_loop_that_hangs_has_one_to_see_to_and_it_tells_who_came_first(folder: Path) -> None:
    async def scenario() -> None:
        async with base(folder) as it:
            await it.ask(latched=False)
            it.changes.clear()
            with Asking(it.node.robot_name, by="the first") as asking:
                asking.go_on(time.monotonic() + PATIENCE_S)
            for _ in range(20):  # in the loop itself, so it does nothing else
                it.stop()
            assert it.halts == 21
            await it.latched()
            await asyncio.sleep(0)
            assert it.changes == [("latched", f"the first (user {os.getuid()}, pid {os.getpid()})")]

    asyncio.run(scenario())


def test_what_halts_may_fail_and_the_loop_latches_all_the_same(folder: Path) -> None:
    async def scenario() -> None:
        async with base(folder) as it:
            await it.ask(latched=False)

            def fail() -> None:
                raise RuntimeError("out of order")

            it.latch._halt = fail
            asking = await asyncio.to_thread(it.stop, 0.1)
            assert [point.service for point in asking.waiting] == ["base"]
            await it.latched()
            await it.kept()
            assert read(folder / "base").latched

    asyncio.run(scenario())


def test_a_disk_that_hangs_holds_up_no_answer_on_the_mesh(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()

    def hang(*_: object) -> int:
        go_on.wait(PATIENCE_S)
        return 0

    async def scenario() -> None:
        async with base(folder) as it:
            await it.ask(latched=False)
            await it.kept()
            monkeypatch.setattr(os, "pwrite", hang)
            reply = await it.operator.call(topics.ESTOP.of("base"), EstopRequest(by="operator"), ROUND_S)
            assert reply.latch == "latched"
            assert "not written within" in reply.text
            reply = await it.operator.call(topics.RESET.of("base"), ResetRequest(by="operator"))
            assert reply.latch == "released"
            assert "not written within" in reply.text
            go_on.set()

    asyncio.run(scenario())
