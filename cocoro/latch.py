"""The emergency stop's latch, as every service that moves something keeps it.

Three ways lead to it, and each latches: the stop path (`cocoro.stop`), a request on the mesh, and the executive's
word. A service comes up latched when its record on disk says so or cannot be read. Otherwise it comes up with the
latch unknown, which counts as latched, and learns it from the executive's word or from an operator's request. What is
latched is released only by an operator's reset, never by the executive's word.
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
from cocoro.messages import EstopReply, EstopRequest, Latch, LatchState
from cocoro.node import Node
from cocoro.stop.path import StopPoint, listen
from cocoro.stop.record import LatchRecord

IN_FLIGHT_NS = NS // 2
"""For so long after a reset a word from before it may still arrive; it is not listened to."""
STOP_KEPT_S, RESET_KEPT_S = 0.15, 0.6
"""How long the answer to a stop and to a reset waits for the disk: less than who asked waits for the answer."""


class LatchKeeper:
    """Keeps the latch of one service: serves `<service>/estop`, follows `executive/latch`, hears the stop path.

    `changed(state, by)` is called in the event loop, before the answer to a request goes out. `halt()` is called at
    once when the stop path is used, in that path's thread: it must stop what moves even if the event loop hangs, be
    brief, and bear being called while anything else happens. `changed` follows as soon as the loop gets to it.
    """

    def __init__(
        self,
        node: Node,
        changed: Callable[[LatchState, str], None],
        halt: Callable[[], None] = lambda: None,
        *,
        follows: bool = True,
    ) -> None:
        """`follows` is False for the executive, whose own word it is that the others follow."""
        self.state: LatchState = "unknown"
        self._node = node
        self._changed = changed
        self._halt = halt
        self._loop = asyncio.get_running_loop()
        self._record: LatchRecord | None = None
        self._lock = threading.Lock()
        self._stopped_by: str | None = None
        """Who used the stop path, while the loop does not know of it yet."""
        self._reset_ns: int | None = None
        if node.latches is not None:
            self._record = LatchRecord(node.latches / node.name)
            if self._record.said.latched:
                said = self._record.said
                self._set("latched", f"{said.by}{f', {said.when}' if said.when else ''}")
            point = StopPoint(node.robot_name, node.name)
            node.keep(point)
            listen(point, self._stopped, self._keep_latched)
        node.serve(topics.ESTOP.of(node.name), self._asked)
        if follows:
            node.on(topics.LATCH, self._heard)

    def stop(self, by: str) -> None:
        """Latch, in the event loop: another part of the service was told to stop."""
        if self.state != "latched":
            self._set("latched", by)

    def word(self, state: LatchState, by: str) -> None:
        """Take another's word for it: it releases only what is unknown, and it may be from before a reset."""
        if state == "released" and self.state == "unknown":
            self._set("released", by)
        elif state == "latched" and self.state != "latched":
            since_reset_ns = None if self._reset_ns is None else self._node.now_ns() - self._reset_ns
            if since_reset_ns is None or not 0 <= since_reset_ns < IN_FLIGHT_NS:
                self._set("latched", by)

    # --- the stop path --------------------------------------------------------------------------------

    def _stopped(self, by: str) -> None:
        """In the stop path's thread. The loop latches afterwards in any case, so a reset that comes between the two
        undoes nothing for longer than a moment. However many stops come, the loop has one to see to."""
        assert self._record is not None
        try:
            self._halt()
        finally:
            self._record.keep(True, by)  # before the loop knows, so that no reset can come first
            with self._lock:
                is_first, self._stopped_by = self._stopped_by is None, self._stopped_by or by
            if is_first:
                with suppress(RuntimeError):  # the loop has ended, and with it what could move anything
                    self._loop.call_soon_threadsafe(self._latch)

    def _latch(self) -> None:
        with self._lock:
            by, self._stopped_by = self._stopped_by, None
        self._set("latched", by or "")

    def _keep_latched(self, _by: str) -> Future[str]:
        """The write that `_stopped` began, or one after it."""
        assert self._record is not None
        return self._record.last

    # --- the mesh -------------------------------------------------------------------------------------

    async def _asked(self, request: EstopRequest) -> EstopReply:
        if request.latched:
            self._set("latched", request.by)
        else:
            self._reset_ns = self._node.now_ns()
            self._set("released", request.by)
        not_kept = await self._not_kept(STOP_KEPT_S if request.latched else RESET_KEPT_S)
        return EstopReply(service=self._node.name, latch=self.state, text=not_kept)  # another may have come meanwhile

    async def _not_kept(self, within_s: float) -> str:
        """Why the disk has not what was set last, or ''."""
        if self._record is None:
            return ""
        try:
            why = await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(self._record.last)), within_s)
        except TimeoutError:
            why = f"{self._record.path}: the disk has not taken it within {within_s:g} s"
        return f"a restart will not remember this: {why}" if why else ""

    def _heard(self, latch: Latch) -> None:
        if is_fresh(latch.stamp_ns, self._node.now_ns(), topics.LATCH.max_age_s):
            self.word(latch.state, latch.by)

    # --- both -----------------------------------------------------------------------------------------

    def _set(self, state: LatchState, by: str) -> None:
        before, self.state = self.state, state
        if self._record is not None:
            self._record.keep(state == "latched", by)
        self._changed(state, by)
        if state != before:  # last, since a log may hang
            level = logging.WARNING if state == "latched" else logging.INFO
            self._node.log.log(level, "emergency stop %s by %s", state, by or "?")
