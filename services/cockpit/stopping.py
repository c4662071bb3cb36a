"""The emergency stop of the page: by the stop path of this machine, and by the mesh to all.

The first datagrams leave before this module does anything else, and a thread of its own hears the answers.
"""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from cocoro.errors import CocoroError
from cocoro.messages import EstopRequest
from cocoro.node import Node
from cocoro.stop.asking import STOPPABLE, Asking, Point, movers_first
from cocoro.topics import ESTOP

PATH_S = 0.6
"""Longest wait for answers on the stop path."""
ROUNDS = 6
"""How often the mesh is asked while a service that moves something is silent."""
ROUND_S = 0.5
"""Longest wait for the answers to one question."""
EXECUTIVE = "executive"
"""It ends its task at a stop, and moves nothing itself."""


class Stopper:
    """Stops the robot, and tells who has acknowledged."""

    def __init__(self, node: Node, tell: Callable[[dict[str, Any]], None]) -> None:
        """`tell` gets each news of a stop, for all viewers."""
        self._node = node
        self._tell = tell
        self._alive: set[str] = set()
        self._running: set[asyncio.Task[dict[str, Any]]] = set()

    def lives(self, service: str, alive: bool) -> None:
        """A service became alive, or ceased to be."""
        (self._alive.add if alive else self._alive.discard)(service)

    def stop(self, by: str) -> asyncio.Task[dict[str, Any]]:
        """Stop everything that moves. The task gives what was told last; the first datagrams have left on return."""
        started_ns = time.monotonic_ns()
        run = _Stop(self._node, by, started_ns, self._tell, set(self._alive))
        run.ask_the_path()
        task = asyncio.ensure_future(run.go_on())
        self._running.add(task)
        task.add_done_callback(self._running.discard)
        return task


class _Stop:
    """One stop."""

    def __init__(
        self, node: Node, by: str, started_ns: int, tell: Callable[[dict[str, Any]], None], alive: set[str]
    ) -> None:
        self._node = node
        self._by = by
        self._started_ns = started_ns
        self._tell = tell
        self._movers = {service for service in STOPPABLE if service in alive}
        self._acknowledged: dict[str, float] = {}
        """The time of each service, ms after the stop arrived here."""
        self._trouble = ""
        self._loop = asyncio.get_running_loop()
        self._path_done = asyncio.Event()

    def ask_the_path(self) -> None:
        """Send the datagrams, and leave the answers to a thread."""
        if self._node.clock.virtual:  # nothing of this machine is in a rehearsal or a test
            self._path_done.set()
            return
        try:
            asking = Asking(self._node.robot_name, f"cockpit: {self._by}", self._heard)
            threading.Thread(target=self._hear, args=(asking,), name="stop answers", daemon=True).start()
        except (OSError, RuntimeError) as error:
            self._trouble = f"the stop path cannot be used ({error}): the mesh alone was asked"
            self._path_done.set()

    def _hear(self, asking: Asking) -> None:
        with asking:
            asking.go_on(time.monotonic() + PATH_S)
            silent = {point.service for point in asking.waiting if point.uid == os.getuid()}
        self._in_loop(self._path_over, silent)

    def _heard(self, point: Point) -> None:
        """Called in the thread."""
        if point.latched_ns is None or point.uid != os.getuid():  # another user's robot of this name
            return
        self._in_loop(self._acknowledge, point.service, (point.latched_ns - self._started_ns) / 1e6)

    def _in_loop(self, callback: Callable[..., None], *arguments: Any) -> None:
        with suppress(RuntimeError):  # the loop has ended meanwhile
            self._loop.call_soon_threadsafe(callback, *arguments)

    def _path_over(self, silent: set[str]) -> None:
        self._movers |= silent - {EXECUTIVE}
        self._path_done.set()

    def _acknowledge(self, service: str, ms: float) -> None:
        first = not self._acknowledged
        if service not in self._acknowledged:
            self._acknowledged[service] = ms
            if first:
                self._tell(self.told(final=False))

    async def go_on(self) -> dict[str, Any]:
        """Ask the mesh, until all that move have acknowledged; then tell the end of it."""
        for _ in range(ROUNDS):
            await self._ask_the_mesh()
            if self._movers <= self._acknowledged.keys():
                break
        await self._path_done.wait()
        told = self.told(final=True)
        self._tell(told)
        return told

    async def _ask_the_mesh(self) -> None:
        with suppress(CocoroError):
            for answer in await self._node.call_all(ESTOP.of("*"), EstopRequest(by=f"cockpit: {self._by}"), ROUND_S):
                if answer.reply is not None and answer.reply.latch == "latched":
                    self._acknowledge(answer.service, (time.monotonic_ns() - self._started_ns) / 1e6)

    def told(self, *, final: bool) -> dict[str, Any]:
        """The news for the page."""
        acknowledged = sorted(self._acknowledged, key=movers_first)
        return {
            "kind": "stopped",
            "acknowledged": acknowledged,
            "missing": sorted(self._movers - self._acknowledged.keys(), key=movers_first) if final else [],
            "ms": round(max(self._acknowledged.values(), default=0.0), 1),
            "by": self._by,
            "final": final,
            "trouble": self._trouble,
        }
