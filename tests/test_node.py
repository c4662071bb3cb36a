"""The node: publishing, reading, liveliness and health."""

from __future__ import annotations

import asyncio
import logging
from itertools import pairwise

import msgspec
import pytest
from node_rig import Mesh, answered, state
from spelled import idle

from cocoro import topics
from cocoro.clock import NS
from cocoro.errors import MeshError
from cocoro.messages import BaseCommand, BaseState, Message
from cocoro.testing import in_virtual_time, settle

# --- publishing -----------------------------------------------------------------------------------


@in_virtual_time
async def test_what_is_published_says_when_and_in_which_order() -> None:
    mesh = Mesh()
    async with mesh.node("base") as node:
        await asyncio.sleep(2.0)
        first = node.publish(topics.BASE_STATE, state())
        second = node.publish(topics.BASE_STATE, state(), stamp_ns=NS)
        third = node.publish(topics.BASE_STATE, state(stamp_ns=3))
    assert [message.stamp_ns for message in (first, second, third)] == [2 * NS, NS, 3]
    assert [message.seq for message in (first, second, third)] == [0, 1, 2]
    assert first.incarnation == second.incarnation == third.incarnation


@in_virtual_time
async def test_a_restarted_publisher_is_another_incarnation() -> None:
    mesh, incarnations = Mesh(), set()
    for _ in range(3):
        async with mesh.node("base") as node:
            incarnations.add(node.publish(topics.BASE_STATE, state()).incarnation)
    assert len(incarnations) == 3


@in_virtual_time
async def test_a_topic_carries_its_own_type_alone() -> None:
    async with Mesh().node("base") as node:
        with pytest.raises(TypeError, match="base/state carries BaseState, not BaseCommand"):
            node.publish(topics.BASE_STATE, BaseCommand(ahead_mps=0.0, turn_radps=0.0))  # type: ignore[misc]


# --- reading --------------------------------------------------------------------------------------


@in_virtual_time
async def test_all_readers_of_a_topic_in_a_node_get_everything() -> None:
    mesh = Mesh()
    async with mesh.node("base") as base, mesh.node("planning") as reader:
        handled: list[BaseState] = []
        reader.on(topics.BASE_STATE, handled.append)
        latest, stream = reader.latest(topics.BASE_STATE), reader.stream(topics.BASE_STATE)
        for number in range(3):
            base.publish(topics.BASE_STATE, state(speed_mps=number))
        await settle()
        assert [message.speed_mps for message in handled] == [0, 1, 2]
        assert [(await stream.next()).speed_mps for _ in range(3)] == [0, 1, 2]
        assert latest.value is not None
        assert latest.value.speed_mps == 2
        assert len([s for s in mesh.mesh.subscriptions if s.keyexpr == "calliope/base/state"]) == 1


@in_virtual_time
async def test_a_robot_never_hears_another_robot() -> None:
    mesh = Mesh()
    async with mesh.node("base", robot_name="bob") as bobs, mesh.node("planning", robot_name="ada") as adas:
        heard = adas.stream(topics.BASE_STATE)
        everyone = adas.stream(topics.HEALTH, service="*")
        bobs.publish(topics.BASE_STATE, state())
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(heard.next(), 10.0)
        assert {(await everyone.next()).service for _ in range(5)} == {"planning"}
        with pytest.raises(MeshError, match=r"nobody answers ada/base/about"):
            await adas.call(topics.ABOUT.of("base"), msgspec.convert({}, topics.ABOUT.request))


# --- life, health and end -------------------------------------------------------------------------


@in_virtual_time
async def test_a_service_is_alive_from_ready_to_its_end() -> None:
    mesh, news = Mesh(), []
    async with mesh.node("watcher") as watcher:
        watcher.watch_alive(lambda service, alive: news.append((service, alive)))
        async with mesh.node("base") as node:
            await settle()
            assert news == []
            node.ready("works")
            node.ready("still works")
            await settle()
            assert news == [("base", True)]
        await settle()
        assert news == [("base", True), ("base", False)]


@in_virtual_time
async def test_health_tells_of_every_topic_and_loop() -> None:
    mesh = Mesh()
    async with mesh.node("base") as node, mesh.node("feeder") as feeder:
        node.ready("works")
        node.stream(topics.BASE_COMMAND)

        async def loop() -> None:
            async for _ in node.every(10.0, "beat"):
                node.publish(topics.BASE_STATE, state())

        node.spawn(loop())
        healths = feeder.stream(topics.HEALTH, service="base")
        feeder.publish(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.0, turn_radps=0.0))
        mesh.mesh.publish(topics.BASE_COMMAND.key("calliope"), b"\xc1")
        await asyncio.sleep(3.5)
        _, first, second = await healths.next(), await healths.next(), await healths.next()
        assert (second.stamp_ns - first.stamp_ns) / NS == pytest.approx(1.0)
        assert (second.service, second.state, second.text) == ("base", "ready", "works")
        ports = {(port.key, port.direction): port for port in second.topics}
        command = ports["calliope/base/command", "in"]
        assert (command.count, command.rejected) == (1, 1)
        assert command.last_error
        assert ports["calliope/base/state", "out"].rate_hz == pytest.approx(10.0)
        assert [loop.name for loop in second.loops] == ["beat"]
        assert second.loops[0].period_median_ms == pytest.approx(100.0)
        assert second.faults == (f"base/command of planning: 1 rejected: {command.last_error}",)


@in_virtual_time
async def test_a_topic_that_can_be_read_no_more_is_told_at_once_and_so_is_its_return() -> None:
    mesh = Mesh()
    async with mesh.node("base") as node, mesh.node("feeder") as feeder:
        node.ready("works")
        node.stream(topics.BASE_COMMAND)
        told: list[tuple[int, bool]] = []
        feeder.on(
            topics.HEALTH,
            lambda health: told.append((health.stamp_ns, any(port.unreadable for port in health.topics))),
            service="base",
        )
        await asyncio.sleep(0.3)
        for _ in range(300):
            feeder.publish(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.0, turn_radps=0.0), 1)
            await asyncio.sleep(0.02)
        feeder.publish(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.0, turn_radps=0.0))
        await asyncio.sleep(0.1)
        changes = [b for a, b in pairwise(told) if a[1] != b[1]]
        assert [unreadable for _, unreadable in changes] == [True, False]
        assert [stamp_ns / NS for stamp_ns, _ in changes] == pytest.approx([5.3, 6.3], abs=0.03)


@in_virtual_time
async def test_background_work_that_fails_degrades_its_node_and_nothing_else(caplog: pytest.LogCaptureFixture) -> None:
    async def fail() -> None:
        raise ZeroDivisionError("in the background")

    async with Mesh().node("base") as node:
        node.spawn(fail())
        await settle()
        assert node.state == "degraded"
        assert "in the background" in node.text
    assert [record.levelno for record in caplog.records] == [logging.ERROR]


@in_virtual_time
async def test_a_node_that_ends_leaves_nothing_behind() -> None:
    mesh = Mesh()
    async with mesh.node("other") as other:
        await settle()  # its first health message is out
        before = (len(asyncio.all_tasks()), len(mesh.mesh.subscriptions), len(mesh.mesh.servers))
        async with mesh.node("base") as node:
            node.ready()
            heard: list[Message] = []
            node.on(topics.INTENT, heard.append)
            node.serve(topics.CANCEL, answered)
            node.watch_alive(lambda service, alive: None)
            node.spawn(asyncio.sleep(1e6))
            await settle()
        other.publish(topics.INTENT, idle())
        await settle()
        assert (len(asyncio.all_tasks()), len(mesh.mesh.subscriptions), len(mesh.mesh.servers)) == before
        assert len(mesh.mesh.watchers) == 0
        assert heard == []


@in_virtual_time
async def test_a_part_of_a_process_is_a_service_of_its_own() -> None:
    mesh = Mesh()
    async with mesh.node("sim", robot_name="ada") as sim, sim.sibling("base") as base:
        base.ready()
        assert (base.name, base.robot_name) == ("base", "ada")
        assert await sim.bus.alive("ada/*/alive") == ["ada/base/alive"]
