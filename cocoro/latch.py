"""The emergency stop's latch, kept by every service that moves something.

Each of three ways latches: the stop path (`cocoro.stop`), a request on the mesh, and the executive's latch topic. A
service starts latched when its record on disk says so or cannot be read. Otherwise it starts with the latch unknown,
which counts as latched, and learns the state from the executive's topic or an operator's request. A latched service is
released only by an operator's reset, never by the executive's topic.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress

from cocoro import topics
from cocoro.clock import NS, is_fresh
from cocoro.messages import EstopReply, EstopRequest, Latch, LatchState, ResetRequest
from cocoro.node import Node
from cocoro.stop.path import StopPoint, listen
from cocoro.stop.record import LatchRecord

IN_FLIGHT_NS = NS // 2
"""After a reset, latch messages from before it may still arrive for this long; they are ignored."""
STOP_KEPT_S, RESET_KEPT_S = 0.15, 0.6
"""Longest wait of the answer to a stop and to a reset for the disk; less than the caller waits for the answer."""


class ServiceLatch:
    """Keeps the latch of one service: serves `<service>/estop` and `<service>/reset`, follows
    `executive/latch`, listens on the stop path.

    `changed(state, by)` is called in the event loop, before the answer to a request is sent. `halt()` is called in the
    stop path's thread as soon as a stop arrives there: it must stop what moves even if the event loop hangs, be brief,
    and be safe at any time. `changed` follows as soon as the event loop runs.
    """

    def __init__(
        self,
        node: Node,
        changed: Callable[[LatchState, str], None],
        halt: Callable[[], None] = lambda: None,
        *,
        follows: bool = True,
    ) -> None:
        """`follows` is False for the executive, which publishes the latch topic itself."""
        self.state: LatchState = "unknown"
        self._node = node
        self._changed = changed
        self._halt = halt
        self._loop = asyncio.get_running_loop()
        self._record: LatchRecord | None = None
        self._lock = threading.Lock()
        self._stopped_by: str | None = None
        """Sender of a stop on the stop path that the event loop has not handled yet."""
        self._reset_ns: int | None = None
        if node.latches is not None:
            self._record = LatchRecord(node.latches / node.name)
            if self._record.entry.latched:
                entry = self._record.entry
                self._set("latched", f"{entry.by}{f', {entry.when}' if entry.when else ''}")
            point = StopPoint(node.robot_name, node.name)
            node.keep(point)
            listen(point, self._stopped, self._keep_latched)
        node.serve(topics.ESTOP.of(node.name), self._stop_requested)
        node.serve(topics.RESET.of(node.name), self._reset_requested)
        if follows:
            node.on(topics.LATCH, self._on_latch)

    def stop(self, by: str) -> None:
        """Latches, in the event loop, because another part of the service was stopped."""
        if self.state != "latched":
            self._set("latched", by)

    def follow(self, state: LatchState, by: str) -> None:
        """Takes over another service's latch state. It can latch, but release only an unknown latch."""
        if state == "released" and self.state == "unknown":
            self._set("released", by)
        elif state == "latched" and self.state != "latched":
            since_reset_ns = None if self._reset_ns is None else self._node.now_ns() - self._reset_ns
            if since_reset_ns is None or not 0 <= since_reset_ns < IN_FLIGHT_NS:
                self._set("latched", by)

    # --- the stop path --------------------------------------------------------------------------------

    def _stopped(self, by: str) -> None:
        """Called in the stop path's thread. The event loop latches afterwards in any case, so a reset between the two
        is overridden within a moment. Many stops are one for the event loop."""
        assert self._record is not None
        try:
            self._halt()
        finally:
            self._record.keep(True, by)  # before the event loop knows, so that no reset can come first
            with self._lock:
                is_first, self._stopped_by = self._stopped_by is None, self._stopped_by or by
            if is_first:
                with suppress(RuntimeError):  # the event loop has ended, and with it all motion
                    self._loop.call_soon_threadsafe(self._latch)

    def _latch(self) -> None:
        with self._lock:
            by, self._stopped_by = self._stopped_by, None
        self._set("latched", by or "")

    def _keep_latched(self, _by: str) -> Future[str]:
        """The write that `_stopped` started, or a later one."""
        assert self._record is not None
        return self._record.last

    # --- the mesh -------------------------------------------------------------------------------------

    async def _stop_requested(self, request: EstopRequest) -> EstopReply:
        self._set("latched", request.by)
        return await self._answer(STOP_KEPT_S)

    async def _reset_requested(self, request: ResetRequest) -> EstopReply:
        self._reset_ns = self._node.now_ns()
        self._set("released", request.by)
        return await self._answer(RESET_KEPT_S)

    async def _answer(self, within_s: float) -> EstopReply:
        not_kept = await self._not_kept(within_s)
        # Another request may have changed the state meanwhile.
        return EstopReply(service=self._node.name, latch=self.state, text=not_kept)

    async def _not_kept(self, within_s: float) -> str:
        """The reason for which the last state is not on the disk; '' when it is."""
        if self._record is None:
            return ""
        try:
            why = await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(self._record.last)), within_s)
        except TimeoutError:
            why = f"{self._record.path}: not written within {within_s:g} s"
        return f"a restart will forget this: {why}" if why else ""

    def _on_latch(self, latch: Latch) -> None:
        if is_fresh(latch.stamp_ns, self._node.now_ns(), topics.LATCH.max_age_s):
            self.follow(latch.state, latch.by)

    # --- both -----------------------------------------------------------------------------------------

    def _set(self, state: LatchState, by: str) -> None:
        before, self.state = self.state, state
        if self._record is not None:
            self._record.keep(state == "latched", by)
        self._changed(state, by)
        if state != before:  # last, since logging may block
            level = logging.WARNING if state == "latched" else logging.INFO
            self._node.log.log(level, "emergency stop %s by %s", state, by or "?")
