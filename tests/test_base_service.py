"""The base service from messages to bytes, with its guard, at the end of an emulated wire, in real time."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from wire_base import DEADMAN_NS, MS, PATIENCE_NS, Bench

from cocoro import topics
from cocoro.clock import RealClock
from cocoro.messages import BaseCommand, BaseState, EstopRequest, Latch, RecoverRequest
from cocoro.testing import ServiceUnderTest
from services.base.service import BaseConfig, BaseService
from sim.wire.line import LineFault

pytestmark = [pytest.mark.zenoh, pytest.mark.alone, pytest.mark.process]

LONG_S = 30.0


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with Bench(tmp_path) as bench:
        yield bench


class Driven:
    """The service under test, and the operations on a base."""

    def __init__(self, bench: Bench, service: ServiceUnderTest) -> None:
        self.bench = bench
        self.service = service
        self.name = service.robot.name
        self.commanded_ns = 0
        """CLOCK_MONOTONIC of the last command."""
        self._driving: asyncio.Task[None] | None = None

    def release(self) -> None:
        self.service.feed(topics.LATCH, Latch(state="released"))

    def drive(self, left_mps: float, right_mps: float) -> None:
        """Command wheel speeds from now on, at 50 Hz."""
        self.silence()
        self._driving = asyncio.ensure_future(self._drive(left_mps, right_mps))

    async def roll(self) -> None:
        """Release the stop and drive at 0.2 m/s; returns when the wheels turn at that speed."""
        self.release()
        self.drive(0.2, 0.2)
        await self.wheels(200, 200)

    def silence(self) -> None:
        if self._driving is not None:
            self._driving.cancel()

    async def _drive(self, left_mps: float, right_mps: float) -> None:
        async for _ in self.service.tester.every(50.0):
            self.commanded_ns = time.monotonic_ns()
            self.service.feed(topics.BASE_COMMAND, self.service.robot.drive.command_of((left_mps, right_mps)))

    async def wheels(self, left: int, right: int) -> int:
        return await asyncio.to_thread(self.bench.until_wheels, left, right)

    async def state(self, good: Callable[[BaseState], object]) -> BaseState:
        """The next state for which the condition holds."""
        async with asyncio.timeout(LONG_S):
            async for state in self.service.tester.stream(topics.BASE_STATE):
                if good(state):
                    return state
        raise AssertionError("the stream ended")

    async def fault(self, text: str) -> None:
        async with asyncio.timeout(LONG_S):
            async for health in self.service.tester.stream(topics.HEALTH.of("base")):
                if any(text in fault for fault in health.faults):
                    return


@asynccontextmanager
async def driven(bench: Bench) -> AsyncIterator[Driven]:
    config = {"port": bench.port}
    async with ServiceUnderTest("services.base.service", config, clock=RealClock()) as service:
        base = Driven(bench, service)
        await base.state(lambda state: state.mode == "safe")
        yield base
        base.silence()


def in_real_time(test: Callable[[Bench], Coroutine[Any, Any, None]]) -> Callable[[Bench], None]:
    def run(bench: Bench) -> None:
        asyncio.run(asyncio.wait_for(test(bench), 60.0))

    run.__name__ = test.__name__
    return run


@in_real_time
async def test_it_stays_still_until_it_knows_the_emergency_stops_state(bench: Bench) -> None:
    async with driven(bench) as base:
        base.drive(0.1, 0.1)
        await base.state(lambda state: state.stopped_by == "latch unknown")
        base.release()
        await base.wheels(100, 100)
        await base.state(lambda state: state.stopped_by == "" and state.latch == "released")


@in_real_time
async def test_wheels_stop_when_no_command_comes_any_more(bench: Bench) -> None:
    async with driven(bench) as base:
        await base.roll()
        base.silence()
        assert await base.wheels(0, 0) - base.commanded_ns < DEADMAN_NS + PATIENCE_NS
        await base.state(lambda state: state.stopped_by == "no command")


@in_real_time
async def test_an_old_command_is_none(bench: Bench) -> None:
    async with driven(bench) as base:
        base.release()
        stamp_ns = base.service.tester.now_ns() - 300 * MS
        base.service.feed(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.2, turn_radps=0.0), stamp_ns)
        base.service.feed(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.1, turn_radps=0.0))
        await base.wheels(100, 100)
        await base.wheels(0, 0)
        assert [wheels for _, wheels in bench.create.acted] == [(100, 100), (0, 0)]


@in_real_time
async def test_the_emergency_stop_is_answered_and_stops_at_once(bench: Bench) -> None:
    async with driven(bench) as base:
        await base.roll()
        asked_ns = time.monotonic_ns()
        reply = await base.service.ask(topics.ESTOP.of("base"), EstopRequest(by="test"))
        assert reply.latch == "latched"
        assert await base.wheels(0, 0) - asked_ns < PATIENCE_NS
        await base.state(lambda state: state.stopped_by == "estop")


@in_real_time
async def test_odometry_tells_the_way_that_the_wheels_went(bench: Bench) -> None:
    async with driven(bench) as base:
        base.release()
        base.drive(0.2, 0.3)
        await base.state(lambda state: state.odometry_yaw_rad > 1.0)
        base.drive(0.0, 0.0)
        await base.state(lambda state: state.speed_mps == 0.0)
        await base.wheels(0, 0)
        left_m, right_m = bench.emulator.call(bench.body.rolled_m.copy)
        state = await base.state(lambda state: True)
        assert state.odometry_yaw_rad == pytest.approx((right_m - left_m) / 0.258, abs=0.05)


@in_real_time
async def test_what_ails_the_create_is_said(bench: Bench) -> None:
    async with driven(bench) as base:
        around = bench.create.sensors
        around.charge_mah = 200
        await base.fault("battery is low: 7%")
        around.left_overcurrent = True
        await base.fault("too much current")
        assert (await base.state(lambda state: state.overcurrent)).battery_fraction == pytest.approx(200 / 2702)
        around.left_overcurrent = False
        around.buttons = 5
        assert (await base.state(lambda state: state.buttons)).buttons == ("play", "advance")
        around.charger = True
        await base.fault("fell back to passive mode at the charger")
        state = await base.state(lambda state: state.charging)
        assert (state.mode, state.stopped_by) == ("passive", "latch unknown")


@in_real_time
async def test_a_fallen_create_is_recovered_on_request(bench: Bench) -> None:
    async with driven(bench) as base:
        base.release()
        bench.create.sensors.cliffs[2] = True
        await base.state(lambda state: state.cliff)
        base.drive(0.1, 0.1)
        await base.state(
            lambda state: state.mode == "safe" and state.stopped_by == "cliff"
        )  # our own reflex kept it from falling
        bench.create.sensors.drop_left = True
        await base.fault("`cocoro base recover`")
        reply = await base.service.ask(topics.RECOVER, RecoverRequest())
        assert not reply.recovered
        assert "wheel" in reply.text
        bench.create.sensors.drop_left = bench.create.sensors.cliffs[2] = False
        assert (await base.service.ask(topics.RECOVER, RecoverRequest())).recovered
        await base.wheels(100, 100)


@pytest.mark.parametrize("way", ["to_device", "to_driver"])
def test_a_disturbed_line_is_told_and_stops_nothing_for_long(bench: Bench, way: str) -> None:
    @in_real_time
    async def scenario(bench: Bench) -> None:
        async with driven(bench) as base:
            await base.roll()
            fault = LineFault("corrupted", 0.01, way, 10**19)  # type: ignore[arg-type]
            bench.emulator.call(lambda: bench.line.disturb(fault))
            await base.fault("its line is disturbed, check the cable")
            bench.emulator.call(bench.line.undisturb)
            bench.emulator.call(lambda: setattr(bench.create, "baud", 57600))  # a flipped bit may have changed it
            await base.service.ask(topics.RECOVER, RecoverRequest())
            await base.wheels(200, 200)

    scenario(bench)


@in_real_time
async def test_an_adapter_that_is_pulled_is_a_fault_and_no_crash(bench: Bench) -> None:
    async with driven(bench) as base:
        bench.emulator.call(bench.line.port.unplug)
        await base.fault("no connection to the Create")
        bench.emulator.call(bench.line.port.plug)
        await base.state(lambda state: state.mode == "safe")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_guard_that_dies_or_hangs_is_replaced_and_the_wheels_stopped_meanwhile(
    bench: Bench, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    services: list[BaseService] = []
    start = BaseService.__init__

    def remember(self: BaseService, *arguments: object) -> None:
        services.append(self)
        start(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(BaseService, "__init__", remember)

    @in_real_time
    async def scenario(bench: Bench) -> None:
        async with driven(bench) as base:
            await base.roll()
            pid = services[0].guard.pid
            assert pid is not None
            base.silence()
            killed_ns = time.monotonic_ns()
            os.kill(pid, number)
            assert await base.wheels(0, 0) - killed_ns < 300 * MS + PATIENCE_NS
            await asyncio.to_thread(bench.emulator.until, lambda: bench.create.mode == 1)  # woken by the next guard
            await asyncio.to_thread(bench.until_awake)
            await base.state(lambda state: state.mode == "safe")
            assert services[0].guard.pid != pid
            base.drive(0.1, 0.1)
            await base.wheels(100, 100)

    scenario(bench)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_wheels_stop_when_the_service_itself_is_killed_or_stopped(bench: Bench, number: signal.Signals) -> None:
    script = Path(__file__).with_name("drive_forever.py")
    service = subprocess.Popen([sys.executable, str(script), bench.port])
    try:
        bench.until_wheels(200, 200)
        killed_ns = time.monotonic_ns()
        service.send_signal(number)
        assert bench.until_wheels(0, 0) - killed_ns < 300 * MS
        if number == signal.SIGSTOP:
            service.send_signal(signal.SIGCONT)
            bench.until_wheels(200, 200)
    finally:
        service.kill()
        service.wait()
    bench.until_wheels(0, 0)


def test_a_service_without_its_port_says_so_and_lives(tmp_path: Path) -> None:
    async def scenario() -> None:
        config = BaseConfig(port=str(tmp_path / "nothing"))
        async with ServiceUnderTest("services.base.service", config, clock=RealClock()) as service:
            async for health in service.tester.stream(topics.HEALTH.of("base")):
                if any("is the adapter plugged in?" in fault for fault in health.faults):
                    assert health.state == "degraded"
                    return

    asyncio.run(asyncio.wait_for(scenario(), LONG_S))
