"""The executive's part in the emergency stop: it keeps the word for hardware services that start later."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from cocoro import topics
from cocoro.clock import NS
from cocoro.latch import ServiceLatch
from cocoro.messages import BaseState, Latch, LatchState, ServoState
from cocoro.node import Node
from cocoro.topics import Topic

_COLD_START_NS = NS // 2
"""When every hardware service has been heard for so long, none knows the latch and no record on disk says that it is
latched, then it is released."""

_STATES: dict[str, Topic[Any]] = {
    topic.service: topic for topic in (topics.BASE_STATE, topics.ARM_STATE, topics.HAND_STATE)
}
"""By service, where each service that moves something reports its latch."""


class Estop:
    """The latch as the executive knows it. Where its own record does not say that it is latched it is unknown until
    all of the hardware has been heard, since any of it may have latched while the executive was not there."""

    def __init__(self, node: Node, rate_hz: float, changed: Callable[[bool, str], None]) -> None:
        self._node = node
        self._by = ""
        self._changed = changed
        self._heard: dict[str, LatchState] = {}
        self._all_unknown_since_ns: int | None = None
        self._said: LatchState = "unknown"
        self._keeper = ServiceLatch(node, self._turned, follows=False)
        for service, topic in _STATES.items():
            node.on(topic, partial(self._hardware, service))
        node.spawn(self._tell(rate_hz))

    @property
    def state(self) -> LatchState:
        return self._said

    @property
    def words(self) -> str:
        """The state and by whom it is so, for people."""
        return f"{self._said} by {self._by}" if self._said == "latched" and self._by else self._said

    def _hardware(self, service: str, state: BaseState | ServoState) -> None:
        latch = state.latch
        self._heard[service] = latch
        if latch == "latched":
            self._keeper.follow("latched", f"{service}, which was latched already")
        elif self._said == "unknown" and set(self._heard) == set(_STATES):
            said = set(self._heard.values())
            if said == {"unknown"}:
                self._nobody_knows()
            elif "latched" not in said:
                self._keeper.follow("released", next(name for name, one in self._heard.items() if one == "released"))

    def _nobody_knows(self) -> None:
        now_ns = self._node.now_ns()
        if self._all_unknown_since_ns is None or now_ns < self._all_unknown_since_ns:
            self._all_unknown_since_ns = now_ns
        elif now_ns - self._all_unknown_since_ns > _COLD_START_NS:
            self._keeper.follow("released", "cold start")

    def _turned(self, state: LatchState, by: str) -> None:
        if state != self._said:
            self._said, self._by = state, by
            self._changed(state == "latched", by)
            self._say()

    def _say(self) -> None:
        self._node.publish(topics.LATCH, Latch(state=self._said, by=self._by))

    async def _tell(self, rate_hz: float) -> None:
        async for _ in self._node.every(rate_hz, "latch"):
            self._say()
