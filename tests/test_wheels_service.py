"""The service of a LeKiwi's line with its guard, at the emulated end of the line, in real time.

How soon wheels stand is judged in virtual time (`test_wheels_line.py`, `test_wheels_world.py`); here, that processes
do their part.
"""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from wheels_rig import lekiwi

from cocoro import topics
from cocoro.clock import RealClock
from cocoro.errors import ConfigError, RefusedError
from cocoro.messages import BaseCommand, BaseState, EstopRequest, Latch, RecoverRequest, ResetRequest
from cocoro.robot import Robot
from cocoro.testing import ServiceUnderTest
from services.base.service import BaseConfig
from services.servos.bus import ServoBus
from services.servos.doctor import check
from services.servos.service import ServosConfig
from services.servos.tools import set_wheel
from services.servos.wheel_service import WheelService
from sim.wire.emulator import Emulator, SimplePlant
from sim.wire.models import servo_of, wheel_of
from sim.wire.servo import EmulatedServoBus

pytestmark = [pytest.mark.zenoh, pytest.mark.alone, pytest.mark.process]

LONG_S = 60.0
TORQUE, SPEED = 40, 46


class WheelBench:
    """A LeKiwi's servos on an emulated line; a context manager."""

    def __init__(self, folder: Path) -> None:
        robot = lekiwi()
        self.wheels = [wheel_of(place, "feetech") for place in robot.base.servo_places]
        joints = [servo_of(777, joint.id, joint.overload_s) for joint in robot.joints.values()]
        bus = EmulatedServoBus([*joints, *self.wheels])
        self.emulator = Emulator(folder, {"bus": bus}, SimplePlant(None, bus))
        self.line = self.emulator.lines["bus"]
        self.port = str(folder / "bus")

    def __enter__(self) -> WheelBench:
        self.emulator.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.emulator.__exit__(None, None, None)

    @property
    def turning(self) -> bool:
        return any(servo.motor.on and servo.motor.endless for servo in self.wheels)

    def until(self, condition: Callable[[], object]) -> None:
        self.emulator.until(condition, LONG_S)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WheelBench]:
    with WheelBench(tmp_path) as bench:
        yield bench


def test_the_guard_stops_wheels_of_a_process_that_is_stopped_or_killed(bench: WheelBench) -> None:
    script = Path(__file__).with_name("drive_wheels_forever.py")
    service = subprocess.Popen([sys.executable, str(script), bench.port])
    try:
        bench.until(lambda: bench.turning)
        service.send_signal(signal.SIGSTOP)
        bench.until(lambda: not bench.turning)
        assert all(servo.get(TORQUE) == 1 for servo in bench.wheels), "they brake"
        service.send_signal(signal.SIGCONT)
        bench.until(lambda: bench.turning)
    finally:
        service.kill()
        service.wait()
    bench.until(lambda: not bench.turning)
    bench.until(lambda: all(servo.get(TORQUE) == 0 for servo in bench.wheels))


class Driven:
    """The service under test, and the operations on its base."""

    def __init__(self, bench: WheelBench, service: ServiceUnderTest) -> None:
        self.bench = bench
        self.service = service
        self._driving = [asyncio.ensure_future(self._drive()), asyncio.ensure_future(self._mend())]

    async def _drive(self) -> None:
        async for _ in self.service.tester.every(50.0):
            self.service.feed(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.1, turn_radps=0.0))

    async def _mend(self) -> None:
        """On a machine that is short of processor time the emulated wheels may come behind, as if they were held."""
        async for health in self.service.tester.stream(topics.HEALTH.of("base")):
            if any("held up" in fault for fault in health.faults):
                await self.service.ask(topics.RECOVER, RecoverRequest(), LONG_S)

    async def until(self, condition: Callable[[], object]) -> None:
        await asyncio.to_thread(self.bench.until, condition)

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

    def end(self) -> None:
        for task in self._driving:
            task.cancel()


@asynccontextmanager
async def driven(bench: WheelBench) -> AsyncIterator[Driven]:
    config = {"ports": {"bus": bench.port}, "reply_s": 0.2}
    async with ServiceUnderTest(
        "services.servos.mobile", config, name="servos-base", robot=lekiwi(), clock=RealClock()
    ) as service:
        base = Driven(bench, service)
        await base.state(lambda state: state.stopped_by == "latch unknown")
        service.feed(topics.LATCH, Latch(state="released"))
        await base.until(lambda: bench.turning)
        yield base
        base.end()


def test_guard_stop_and_line_each_stop_the_wheels_and_let_them_turn_again(
    bench: WheelBench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    services: list[WheelService] = []
    start = WheelService.__init__

    def remember(self: WheelService, *arguments: object) -> None:
        services.append(self)
        start(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(WheelService, "__init__", remember)

    async def scenario() -> None:
        async with driven(bench) as base:
            moving = await base.state(lambda state: state.speed_mps > 0.08)
            await base.state(lambda state: state.odometry_m[0] > moving.odometry_m[0] + 0.01)

            reply = await base.service.ask(topics.ESTOP.of("base"), EstopRequest(by="test"))
            assert reply.latch == "latched"
            await base.until(lambda: not bench.turning)
            await base.state(lambda state: state.stopped_by == "estop" and state.standing)
            await base.service.ask(topics.RESET.of("base"), ResetRequest(by="test"))
            await base.until(lambda: bench.turning)

            guard = services[0].guard
            pid = guard.pid
            assert pid is not None
            os.kill(pid, signal.SIGKILL)
            # The faults have that for some milliseconds, until the other guard reports: the log keeps it.
            await base.until(lambda: "the guard of the port died" in caplog.text)
            await base.until(lambda: bench.turning)  # with another guard
            assert guard.pid != pid

            bench.emulator.call(bench.line.port.unplug)
            await base.fault("there is no such port: is the adapter plugged in?")
            speeds = bench.emulator.call(lambda: [servo.get(SPEED) for servo in bench.wheels])
            assert any(speeds), "what nothing can reach turns on"
            for servo in bench.wheels:
                servo.acted.clear()
            bench.emulator.call(bench.line.port.plug)
            await base.until(lambda: all(servo.acted for servo in bench.wheels))
            assert {servo.acted[0][1:] for servo in bench.wheels} == {(SPEED, 0)}, "it is stopped first of all"
            await base.service.ask(topics.RECOVER, RecoverRequest(), LONG_S)
            await base.until(lambda: bench.turning)
        await base.until(lambda: not bench.turning)

    asyncio.run(asyncio.wait_for(scenario(), 4 * LONG_S))


def test_each_base_has_the_process_that_drives_it() -> None:
    async def scenario(component: str, config: object, robot: Robot) -> None:
        async with ServiceUnderTest(component, config, name="base", robot=robot, clock=RealClock()):  # type: ignore[arg-type]
            await asyncio.sleep(0.0)

    with pytest.raises(ConfigError, match="the process for wheels with servos is servos-base"):
        asyncio.run(scenario("services.base.service", BaseConfig(), lekiwi()))
    with pytest.raises(
        ConfigError, match="no servos turn the wheels of calliope: name the processes `base` and `servos`"
    ):
        asyncio.run(scenario("services.servos.mobile", {}, Robot.load()))


def test_the_doctor_knows_wheels_and_a_tool_sets_them_up(bench: WheelBench) -> None:
    config = ServosConfig(ports={"bus": bench.port}, reply_s=0.2)
    assert {one.state for one in check(config, lekiwi(), "robbie")} == {"ok"}
    back = bench.wheels[1]
    bench.emulator.call(lambda: back.put(33, 0))
    (bad,) = [one for one in check(config, lekiwi(), "robbie") if one.state == "bad"]
    assert bad.name == "servo 8, wheel back"
    assert "is not set up as a wheel: `cocoro servos set-wheel 8`" in bad.text
    with ServoBus(bench.port, 1_000_000, 0.2, tries=3) as bus:
        set_wheel(bus, 8, turns=True)
        assert bus.is_wheel(8)
        bench.emulator.call(back.power_up)
        assert bus.is_wheel(8), "it keeps that without power"
        set_wheel(bus, 8, turns=False)
        assert not bus.is_wheel(8)
        with pytest.raises(RefusedError, match="no servo answers as 99"):
            set_wheel(bus, 99, turns=True)
