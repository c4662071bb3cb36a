"""Nodes whose core's outputs are late by a fixed time, as if computing them took that much longer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cocoro.clock import NS, Clock, sleep
from cocoro.core import Core, Output
from cocoro.messages import AboutReply
from cocoro.node import Node
from cocoro.stepper import Host, Stepper


class DelayedStepper(Stepper):
    """Publishes a step's outputs `latency_s` after the step, stamped with that later time: a command's age counts from
    when it could have been given."""

    def __init__(self, host: Host, core: Core, name: str, clock: Clock, latency_s: float) -> None:
        super().__init__(host, core, name)
        self._clock = clock
        self._latency_s = latency_s

    async def __call__(self, now_ns: int) -> int:
        samples, computed = self.compute(now_ns)
        outputs: Sequence[Output] = computed
        stamp_ns = now_ns
        if outputs:
            if not await sleep(self._clock, self._latency_s):
                outputs = ()  # the clock jumped back meanwhile, so the result belongs to no epoch
            stamp_ns += round(self._latency_s * NS)
        return self.publish(now_ns, samples, outputs, stamp_ns)


class DelayedNode(Node):
    """A node with an injected latency: the `latency_s` of a profile's `[service.NAME]` table, and of rehearsals. With
    0 s it is a node like any other."""

    def __init__(self, *args: Any, latency_s: float = 0.0, **options: Any) -> None:
        super().__init__(*args, **options)
        self.latency_s = latency_s

    def stepper(self, core: Core, name: str | None = None) -> Stepper:
        if self.latency_s <= 0:
            return super().stepper(core, name)
        return DelayedStepper(self, core, name or self.name, self.clock, self.latency_s)

    def about(self) -> AboutReply:
        reply = super().about()
        reply.latency_s = self.latency_s
        return reply
