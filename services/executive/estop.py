"""The executive's part in the emergency stop: it publishes the latch for hardware services that start later."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from cocoro import topics
from cocoro.clock import NS
from cocoro.latch import ServiceLatch
from cocoro.messages import BaseState, Latch, LatchState, ServoState
from cocoro.node import Node
from cocoro.topics import Topic

_COLD_START_NS = NS // 2
"""Time after which the latch is released when all hardware services report it as unknown and no record on disk has it
latched."""

_STATES: dict[str, Topic[Any]] = {
    topic.service: topic for topic in (topics.BASE_STATE, topics.ARM_STATE, topics.HAND_STATE)
}
"""The topic on which each service that moves something reports its latch, by service."""


class Estop:
    """The latch as the executive knows it. Unless its own record has it latched, it is unknown until all hardware
    services have reported, because any of them may have latched while the executive was not running."""

    def __init__(self, node: Node, rate_hz: float, changed: Callable[[bool, str], None]) -> None:
        self._node = node
        self._by = ""
        self._changed = changed
        self._reported: dict[str, LatchState] = {}
        self._all_unknown_since_ns: int | None = None
        self._state: LatchState = "unknown"
        self._known = asyncio.Event()
        self._latch = ServiceLatch(node, self._on_change, follows=False)
        for service, topic in _STATES.items():
            node.on(topic, partial(self._hardware, service))
        node.spawn(self._repeat(rate_hz))

    @property
    def state(self) -> LatchState:
        return self._state

    @property
    def refusal(self) -> str:
        """The reason for which no task may start, with advice; '' when the stop is released."""
        if self._state == "released":
            return ""
        if self._state == "latched":
            by = f" by {self._by}" if self._by else ""
            return f"the emergency stop is latched{by}; release it first (cocoro reset)"
        unheard = ", ".join(service for service in _STATES if service not in self._reported)
        why = f"{unheard} did not report it" if unheard else "the robot has only just started"
        return f"it is not known yet whether the emergency stop is latched ({why}); see cocoro status"

    async def known(self, timeout_s: float) -> bool:
        """Waits until the state is known, for at most `timeout_s` by the machine's clock; returns whether it is."""
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._known.wait()
        return self._known.is_set()

    def _hardware(self, service: str, state: BaseState | ServoState) -> None:
        latch = state.latch
        self._reported[service] = latch
        if latch == "latched":
            self._latch.follow("latched", f"{service}, which was latched already")
        elif self._state == "unknown" and set(self._reported) == set(_STATES):
            reported = set(self._reported.values())
            if reported == {"unknown"}:
                self._all_unknown()
            elif "latched" not in reported:
                self._latch.follow("released", next(name for name, one in self._reported.items() if one == "released"))

    def _all_unknown(self) -> None:
        now_ns = self._node.now_ns()
        if self._all_unknown_since_ns is None or now_ns < self._all_unknown_since_ns:
            self._all_unknown_since_ns = now_ns
        elif now_ns - self._all_unknown_since_ns > _COLD_START_NS:
            self._latch.follow("released", "cold start")

    def _on_change(self, state: LatchState, by: str) -> None:
        if state != self._state:
            self._state, self._by = state, by
            self._known.set()
            self._changed(state == "latched", by)
            self._publish()

    def _publish(self) -> None:
        self._node.publish(topics.LATCH, Latch(state=self._state, by=self._by))

    async def _repeat(self, rate_hz: float) -> None:
        async for _ in self._node.every(rate_hz, "latch"):
            self._publish()
