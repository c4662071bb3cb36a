"""The executive's part in the emergency stop: it keeps the word for hardware services that start later."""

from __future__ import annotations

import logging
from collections.abc import Callable

from cocoro import topics
from cocoro.clock import NS
from cocoro.messages import EstopReply, EstopRequest, Latch, LatchState
from cocoro.node import Node

_IN_FLIGHT_NS = NS // 2
_COLD_START_NS = NS // 2
"""When every hardware service has been heard for so long and none knows the latch, nobody ever latched it."""


class Estop:
    """The latch as the executive knows it: unknown until the hardware, or its silence on it, has been heard."""

    def __init__(self, node: Node, rate_hz: float, changed: Callable[[bool, str], None]) -> None:
        self.state: LatchState = "unknown"
        self._node = node
        self._by = ""
        self._changed = changed
        self._reset_ns: int | None = None
        self._heard: dict[str, LatchState] = {}
        self._all_unknown_since_ns: int | None = None
        node.serve(topics.ESTOP.of(node.name), self._asked)
        node.on(topics.BASE_STATE, lambda state: self._hardware("base", state.latch))
        node.on(topics.ARM_STATE, lambda state: self._hardware("arm", state.latch))
        node.on(topics.HAND_STATE, lambda state: self._hardware("hand", state.latch))
        node.spawn(self._tell(rate_hz))

    async def _asked(self, request: EstopRequest) -> EstopReply:
        if not request.latched:
            self._reset_ns = self._node.now_ns()
        self._set("latched" if request.latched else "released", request.by)
        return EstopReply(service=self._node.name, latch=self.state)

    def _hardware(self, service: str, latch: LatchState) -> None:
        self._heard[service] = latch
        now_ns = self._node.now_ns()
        if latch == "latched" and self.state != "latched":
            if self._reset_ns is None or not 0 <= now_ns - self._reset_ns <= _IN_FLIGHT_NS:
                self._set("latched", f"{service}, which was latched already")
        elif self.state == "unknown":
            if latch == "released":
                self._set("released", service)
            elif set(self._heard) == set(topics.STOPPABLE) and set(self._heard.values()) == {"unknown"}:
                if self._all_unknown_since_ns is None or now_ns < self._all_unknown_since_ns:
                    self._all_unknown_since_ns = now_ns
                elif now_ns - self._all_unknown_since_ns > _COLD_START_NS:
                    self._set("released", "cold start")

    def _set(self, state: LatchState, by: str) -> None:
        if state != self.state:
            level = logging.WARNING if state == "latched" else logging.INFO
            self._node.log.log(level, "emergency stop %s by %s", state, by or "?")
            self.state, self._by = state, by
            self._changed(state == "latched", by)
            self._say()

    def _say(self) -> None:
        self._node.publish(topics.LATCH, Latch(state=self.state, by=self._by))

    async def _tell(self, rate_hz: float) -> None:
        async for _ in self._node.every(rate_hz, "latch"):
            self._say()
