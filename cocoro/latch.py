"""The emergency stop's latch, as every hardware service keeps it.

A service comes up with the latch unknown, which counts as latched, and learns it from the executive's word or from
an operator's request. What is latched is released only by an operator's reset, never by the executive's word.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from cocoro import topics
from cocoro.clock import NS, is_fresh
from cocoro.messages import EstopReply, EstopRequest, Latch, LatchState
from cocoro.node import Node

_IN_FLIGHT_NS = NS // 2
"""For so long after a reset a word from before it may still arrive; it is not listened to."""


class LatchKeeper:
    """Serves `<service>/estop` and follows `executive/latch` for one hardware service.

    `changed(state, by)` is called at once, in the event loop, so that the hardware stops before the answer goes out.
    """

    def __init__(self, node: Node, changed: Callable[[LatchState, str], None]) -> None:
        self.state: LatchState = "unknown"
        self._node = node
        self._changed = changed
        self._reset_ns: int | None = None
        node.serve(topics.ESTOP.of(node.name), self._asked)
        node.on(topics.LATCH, self._heard)

    async def _asked(self, request: EstopRequest) -> EstopReply:
        if request.latched:
            self._set("latched", request.by)
        else:
            self._reset_ns = self._node.now_ns()
            self._set("released", request.by)
        return EstopReply(service=self._node.name, latch=self.state)

    def _heard(self, latch: Latch) -> None:
        now_ns = self._node.now_ns()
        if not is_fresh(latch.stamp_ns, now_ns, topics.LATCH.max_age_s):
            return
        if latch.state == "released":
            if self.state == "unknown":
                self._set("released", latch.by)
        elif latch.state == "latched" and self.state != "latched":
            if self._reset_ns is not None and 0 <= now_ns - self._reset_ns < _IN_FLIGHT_NS:
                return
            self._set("latched", latch.by)

    def _set(self, state: LatchState, by: str) -> None:
        if state != self.state:
            level = logging.WARNING if state == "latched" else logging.INFO
            self._node.log.log(level, "emergency stop %s by %s", state, by or "?")
        self.state = state
        self._changed(state, by)
