"""What the services of a line have in common: one takes part in the mesh for the joints of a group, one for the wheels.

The line's thread goes by CLOCK_MONOTONIC, the core by the robot's clock.
"""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from typing import Any

from cocoro import topics
from cocoro.errors import CocoroError
from cocoro.faults import FaultReporter
from cocoro.messages import ServoReply, ServoRequest
from cocoro.node import Node
from services.servos.cycle import CycleResult
from services.servos.watch import ServoWatch

DONE_S = 2.0


class LineParticipant(ABC):
    """One of a line's services."""

    core: ServoWatch[Any]

    def __init__(self, node: Node) -> None:
        self._node = node
        self._reporter = FaultReporter(node)
        self._epoch = node.clock.epoch
        self._changed = asyncio.Event()
        node.serve(topics.SERVOS.of(node.name), self._asked)

    @abstractmethod
    def _order(self, now_ns: int) -> None:
        """Give the line what the core orders now."""

    @abstractmethod
    def _publish(self, now_ns: int) -> None:
        """Publish the core's state."""

    def take(self, result: CycleResult) -> None:
        """Take the results of a cycle, which may have those of other services' servos in it."""
        core, now_ns = self.core, self._node.now_ns()
        if self._node.clock.epoch != self._epoch:
            self._epoch = self._node.clock.epoch
            core.new_epoch()
        mine = result.of(core.servos)
        mine.tell(core, now_ns, time.monotonic_ns())
        self._order(now_ns)
        if now_ns:
            self._publish(now_ns)
        self.report_faults()
        self._changed.set()

    async def _asked(self, request: ServoRequest) -> ServoReply:
        core = self.core
        if unknown := core.unknown(request.joints):
            known = ", ".join(one.name for one in core.servos.values())
            raise CocoroError(f"{self._node.name} has no joint {unknown[0]!r}; it has {known}")
        act = {"clear": core.clear, "relax": core.relax, "hold": core.hold}[request.action]
        names = act(request.joints)
        left = [name for name in names if not self._is_done(name, request.action)]
        try:
            async with asyncio.timeout(DONE_S):
                while left:
                    self._changed.clear()
                    await self._changed.wait()
                    left = [name for name in left if not self._is_done(name, request.action)]
        except TimeoutError:
            pass
        why = "; ".join(core.faults(self._node.now_ns())) or core.stopped_by(self._node.now_ns())
        text = f"{', '.join(left)}: not done{f', {why}' if why else ''}" if left else ""
        return ServoReply(joints=tuple(name for name in names if name not in left), text=text)

    def _is_done(self, name: str, action: str) -> bool:
        one = next(one for one in self.core.servos.values() if one.name == name)
        return not one.enabled if action == "relax" else one.enabled

    def report_faults(self) -> None:
        core = self.core
        silent = "servos do not answer" if core.silent_servos() else ""
        degraded = "no line" if core.port_fault else silent
        self._reporter.report(core.faults(self._node.now_ns()), degraded=degraded)
