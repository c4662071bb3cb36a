"""The emergency stop's path at the base: the guard receives it directly, whatever the service above does."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import Awaitable, Callable, Iterator
from copy import copy
from pathlib import Path

import pytest
from stop_rig import PATIENCE_S, new_robot, stopped_ns
from test_base_service import Driven
from wire_base import PATIENCE_NS, Bench, FakeService, guarded

from cocoro import topics
from cocoro.clock import RealClock
from cocoro.messages import ResetRequest
from cocoro.robot import Robot
from cocoro.stop.record import prepare, read
from cocoro.testing import ServiceUnderTest

pytestmark = [pytest.mark.zenoh, pytest.mark.alone, pytest.mark.process]


@pytest.fixture
def name() -> str:
    return new_robot()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with Bench(tmp_path) as bench:
        yield bench


@pytest.fixture
def service(bench: Bench, name: str) -> Iterator[FakeService]:
    """A Create in its mode, with a guard that obeys, also the emergency stop of the robot with this name."""
    with guarded(bench, robot=name) as service:
        bench.until_awake()
        service.report(link="up")
        yield service


def test_the_guard_stops_the_wheels_by_itself_and_asking_on_does_not_help(
    bench: Bench, service: FakeService, name: str
) -> None:
    service.keep_asking(200, 200)
    bench.until_wheels(200, 200)
    asked_ns = time.monotonic_ns()
    answers = stopped_ns(name)
    assert answers["wheels"] is not None
    assert bench.until_wheels(0, 0) - asked_ns < PATIENCE_NS
    bench.forget()
    for _ in range(20):  # a second and more of reports, while the service goes on asking
        assert service.report(why="estop")["stops"] == 1
    assert bench.emulator.call(bench.create.acted.copy) == []


def test_only_a_reset_that_knows_of_the_stop_lets_the_wheels_turn_again(
    bench: Bench, service: FakeService, name: str
) -> None:
    stopped_ns(name)
    service.report(stops=1)
    stopped_ns(name)
    service.reset = 1  # this one does not know of the second
    service.keep_asking(200, 200)
    service.report(stops=2, why="estop")
    service.reset = 2
    bench.until_wheels(200, 200)


@pytest.mark.parametrize("reset", [-1, 10**30, True])
def test_a_reset_of_more_stops_than_there_were_resets_none_to_come(
    bench: Bench, service: FakeService, name: str, reset: int
) -> None:
    service.reset = reset
    service.ask(0, 0)
    service.report(why="")
    stopped_ns(name)
    service.reset = 0
    service.keep_asking(200, 200)
    service.report(stops=1, why="estop")
    assert bench.create.wheels_mmps == (0, 0)


@pytest.fixture
def latches(tmp_path: Path) -> Path:
    """The folder of the base's latch record, which is released."""
    folder = tmp_path / "latch"
    prepare(folder, ["base"], by_hand=True)
    return folder


def while_rolling(scenario: Callable[[Driven, Path], Awaitable[None]]) -> Callable[[Bench, str, Path], None]:
    """A scenario with the base service and its guard, which drive straight when it begins."""

    async def run(bench: Bench, name: str, latches: Path) -> None:
        robot = copy(Robot.load())
        robot.name = name
        config = {"port": bench.port}
        async with ServiceUnderTest(
            "services.base.service", config, robot=robot, clock=RealClock(), latches=latches
        ) as service:
            base = Driven(bench, service)
            await base.state(lambda state: state.mode == "safe")
            await base.roll()
            await scenario(base, latches)
            base.silence()

    def test(bench: Bench, name: str, latches: Path) -> None:
        asyncio.run(asyncio.wait_for(run(bench, name, latches), PATIENCE_S))

    test.__name__ = scenario.__name__
    return test


@while_rolling
async def test_service_and_guard_are_both_told_and_a_reset_releases_both(base: Driven, latches: Path) -> None:
    asked_ns = time.monotonic_ns()
    answers = await asyncio.to_thread(stopped_ns, base.name)
    assert set(answers) == {"base", "wheels"}
    assert None not in answers.values()
    assert await base.wheels(0, 0) - asked_ns < PATIENCE_NS
    state = await base.state(lambda state: state.stopped_by == "estop")
    assert state.latch == "latched"
    assert read(latches / "base").latched
    await asyncio.to_thread(stopped_ns, base.name)
    base.release()  # the executive's word releases nothing
    await base.state(lambda state: state.latch == "latched")
    reply = await base.service.ask(topics.RESET.of("base"), ResetRequest(by="test"))
    assert reply.latch == "released"
    await base.wheels(200, 200)
    assert not read(latches / "base").latched


@while_rolling
async def test_a_loop_that_hangs_keeps_the_wheels_from_nothing(base: Driven, latches: Path) -> None:
    asked_ns = time.monotonic_ns()
    answers = stopped_ns(base.name)  # in the loop, which hangs meanwhile
    assert None not in answers.values()
    assert base.bench.until_wheels(0, 0) - asked_ns < PATIENCE_NS
    await base.state(lambda state: state.latch == "latched")


@while_rolling
async def test_a_guard_that_comes_after_a_stop_knows_of_it_from_the_service(base: Driven, latches: Path) -> None:
    await asyncio.to_thread(stopped_ns, base.name)
    await base.state(lambda state: state.latch == "latched")
    before = guards(base.name)
    for pid in before:
        os.kill(pid, signal.SIGKILL)
    base.bench.forget()
    state = await base.state(lambda state: state.stopped_by == "estop" and not before & guards(base.name))
    assert state.latch == "latched"
    assert all(wheels == (0, 0) for _, wheels in base.bench.emulator.call(base.bench.create.acted.copy))


def guards(name: str) -> set[int]:
    """Process ids of the guards of a robot's wheels."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            arguments = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:  # it has just ended
            continue
        if b"services.base.guard" in arguments and name.encode() in arguments:
            found.add(int(folder.name))
    return found
