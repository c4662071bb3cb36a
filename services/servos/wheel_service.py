"""The service `base` of a robot whose wheels are turned by servos: connects their core, their guard and their line to
the mesh. It has the keys that `services.base` has for a Create."""

from __future__ import annotations

import asyncio
import time

from cocoro import topics
from cocoro.guarding import HANGS_S
from cocoro.joints import Network
from cocoro.latch import ServiceLatch
from cocoro.messages import BaseCommand, LatchState, RecoverReply, RecoverRequest
from cocoro.node import Node
from services.servos.families import FAMILIES
from services.servos.serving import LineParticipant
from services.servos.wheel_guard import Report, WheelGuard
from services.servos.wheel_orders import WheelOrders
from services.servos.wheels import WheelGroup

RECOVERY_S = 2.0


class WheelService(LineParticipant):
    def __init__(self, node: Node, port: str, row: Network) -> None:
        """`port` and `row` are those of the line with the wheels' servos."""
        base, family = node.robot.base, FAMILIES[row.protocol]
        super().__init__(node)
        self.core: WheelGroup = WheelGroup(base, family)
        self.orders = WheelOrders(base, family.units)
        robot = node.robot_name if node.latches is not None else None
        self.guard = WheelGuard(port, row.baud, family, base, self.orders, self._guarded, self._unguarded, robot)
        self._stops = 0
        """Count of emergency stops that the guard received."""
        self._latch = ServiceLatch(node, self._latched, self.orders.halt)
        node.on(topics.BASE_COMMAND, self._commanded)
        node.serve(topics.RECOVER, self._recover)

    async def watch(self) -> None:
        """Look after the guard, for ever."""
        while True:
            self.guard.check()
            await asyncio.sleep(HANGS_S / 10)  # by real time, as the guard goes

    def _commanded(self, command: BaseCommand) -> None:
        now_ns = self._node.now_ns()
        self.core.command(command, now_ns)
        self._order(now_ns)

    def _order(self, now_ns: int) -> None:
        wheels_mps, for_ns = self.core.wheels(now_ns)
        self.orders.give(wheels_mps, time.monotonic_ns() + for_ns)

    def _publish(self, now_ns: int) -> None:
        if (state := self.core.state(now_ns)) is not None:
            self._node.publish(topics.BASE_STATE, state)

    def _latched(self, state: LatchState, by: str) -> None:
        if state == "released":
            self.guard.reset(self._stops)
        self.core.set_latch(state)
        self._order(self._node.now_ns())
        self.orders.go_on()  # these orders know of the latch

    def _guarded(self, report: Report) -> None:
        self.core.guard_fault = report.why and f"the guard of the wheels cannot write to them: {report.why}"
        stops, self._stops = self._stops, report.stops
        if report.stops > stops:
            self._latch.stop("the guard of its wheels, which received a stop")

    def _unguarded(self, why: str) -> None:
        self.core.guard_fault = why
        self._stops = 0  # a new guard counts from 0

    async def _recover(self, _: RecoverRequest) -> RecoverReply:
        core = self.core
        core.recover()
        try:
            async with asyncio.timeout(RECOVERY_S):
                while not core.ready:
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            pass
        if core.ready:
            return RecoverReply(recovered=True)
        now_ns = self._node.now_ns()
        return RecoverReply(recovered=False, text="; ".join(core.faults(now_ns)) or core.stopped_by(now_ns))
