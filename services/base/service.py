"""The base service: connects the guard, which owns the port, and the driver, the pure core, to the mesh."""

from __future__ import annotations

import asyncio
import time
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from cocoro import topics
from cocoro.component import Implementation
from cocoro.errors import ConfigError
from cocoro.faults import FaultReporter
from cocoro.latch import ServiceLatch
from cocoro.messages import BaseCommand, LatchState, RecoverReply, RecoverRequest
from cocoro.node import Node
from cocoro.ports import port_path
from services.base.driver import BaseDriver, GuardReport
from services.base.guard_supervisor import GuardSupervisor

BEAT_S = 0.02
"""Period of the requests to the guard, a tenth of the time after which it stops the wheels."""
RECOVERY_S = 2.0
DEGRADED = {"up": "", "waking": "waking the Create", "fallen": "not obeying"}
"""State text of the service by the link to the Create; 'no Create' for the others."""


class BaseConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    port: str = "/dev/cocoro-create"
    """The serial port: a device, or wire:NAME for an emulated one."""
    mode: Literal["safe", "full"] = "safe"
    """In safe mode the Create itself also stops at cliffs, when a wheel drops and at the charger."""
    guard_timeout_s: Annotated[float, Meta(gt=0.05, le=1.0)] = 0.2
    """The guard stops the wheels when the service has not asked for this long."""


class BaseService:
    def __init__(self, node: Node, config: BaseConfig) -> None:
        if node.robot.base.kind != "differential":
            hint = "" if node.robot.wheel_line is None else "; the process for wheels with servos is servos-base"
            kind = node.robot.base.kind
            raise ConfigError(f"a Create has two wheels on one axle, but [base] kind = {kind!r}{hint}")
        self._node = node
        self._reporter = FaultReporter(node)
        self._driver = BaseDriver(node.robot.base)
        port = port_path(config.port, node.robot_name)
        robot = node.robot_name if node.latches is not None else None
        self.guard = GuardSupervisor(port, config.mode, config.guard_timeout_s, self._on_report, robot)
        self._stops = self._reset_stops = 0
        """Count of emergency stops that the guard received, and how many of them were reset."""
        self._epoch = node.clock.epoch
        self._changed = asyncio.Event()
        self._latch = ServiceLatch(node, self._latched, self._halt)
        node.on(topics.BASE_COMMAND, self._commanded)
        node.serve(topics.RECOVER, self._recover)

    async def run(self) -> None:
        async with self.guard:
            self._report_faults()
            self._node.spawn(self._beat())
            async for now_ns in self._node.every(self._node.robot.base.state_rate_hz, "state"):
                if (state := self._driver.state(now_ns)) is not None:
                    self._node.publish(topics.BASE_STATE, state)
                self._report_faults()

    async def _beat(self) -> None:
        """Ask the guard steadily, which keeps the wheels turning. Goes by real time, as the guard does."""
        while True:
            self.guard.check()
            self._ask()
            await asyncio.sleep(BEAT_S)

    def _ask(self) -> None:
        if self._node.clock.epoch != self._epoch:
            self._epoch = self._node.clock.epoch
            self._driver.new_epoch()
        left_mmps, right_mmps, for_ns = self._driver.wheels(self._node.now_ns())
        patience_s = self._node.robot.base.patience_s(max(abs(left_mmps), abs(right_mmps)) / 1000.0)
        self.guard.ask(left_mmps, right_mmps, for_ns, self._reset_stops, patience_s)

    def _commanded(self, command: BaseCommand) -> None:
        self._driver.command(command, self._node.now_ns())
        self._ask()

    def _latched(self, state: LatchState, by: str) -> None:
        if state == "released":
            self._reset_stops = self._stops
        self._driver.set_latch(state)
        self._ask()

    def _halt(self) -> None:
        """Stop without waiting for the event loop. Called in the stop path's thread."""
        self._driver.set_latch("latched")
        self.guard.halt()

    def _on_report(self, report: GuardReport) -> None:
        age_ns = max(time.monotonic_ns() - report.t, 0)
        stops, self._stops = self._stops, report.stops
        if report.stops > stops:
            self._latch.stop("the guard of its wheels, which received a stop")
        elif report.stops < stops:  # a new guard counts from 0
            self._reset_stops = 0
        before = self._driver.link
        self._driver.take(report, self._node.now_ns() - age_ns)
        if self._driver.link != before:
            self._node.log.info("the Create's link is %s%s", report.link, f": {report.why}" if report.why else "")
            self._changed.set()

    async def _recover(self, _: RecoverRequest) -> RecoverReply:
        driver = self._driver
        if driver.link == "fallen":
            self.guard.recover()
        try:
            async with asyncio.timeout(RECOVERY_S):
                while driver.link != "up":
                    self._changed.clear()
                    await self._changed.wait()
                    if driver.link == "fallen":  # again: its cause is still there
                        break
        except TimeoutError:
            pass
        if driver.link == "up":
            return RecoverReply(recovered=True)
        return RecoverReply(recovered=False, text="; ".join(driver.faults()) or driver.why)

    def _report_faults(self) -> None:
        self._reporter.report(self._driver.faults(), degraded=DEGRADED.get(self._driver.link, "no Create"))


async def run(node: Node, config: BaseConfig) -> None:
    """Serve for ever."""
    await BaseService(node, config).run()


implementation = Implementation(BaseConfig, run)
