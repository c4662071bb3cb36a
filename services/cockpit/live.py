"""The WebSocket of a page that looks at the robot as it is now."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from services.cockpit.access import Gate, Visitor
from services.cockpit.asking import Reply
from services.cockpit.cockpit import Cockpit, Viewer
from services.cockpit.driver import Driver
from services.cockpit.orders import (
    RIGHTS,
    BeginDrive,
    Cancel,
    Drive,
    EndDrive,
    Id,
    LiveOrder,
    Log,
    Look,
    Order,
    Reset,
    Run,
    Seen,
    Stop,
    What,
    live_decoder,
)
from services.cockpit.pointing import what
from services.cockpit.scene import encoded
from services.cockpit.socket_talk import reply_text, spoken, stop_reply

AT_ONCE = 8
"""Requests of one viewer that may be under way."""


class LiveSocket:
    """One connection from its acceptance to its end."""

    def __init__(self, cockpit: Cockpit, socket: WebSocket, gate: Gate, visitor: Visitor) -> None:
        self._cockpit = cockpit
        self._socket = socket
        self._gate = gate
        self._visitor = visitor
        self._decoder = live_decoder()
        self._asking: set[asyncio.Task[None]] = set()
        self._driver: Driver

    async def run(self) -> None:
        """Serve the page until one of both ends the connection."""
        await self._socket.accept()
        viewer = self._cockpit.enter(self._visitor)
        self._driver = Driver(self._cockpit, viewer)
        sending = asyncio.ensure_future(self._send(viewer))
        try:
            while (order := await spoken(self._socket, self._decoder)) is not None:
                self._obey(order, viewer)
        finally:
            self._cockpit.leave(viewer)
            self._driver.close()
            for task in (sending, *self._asking):
                task.cancel()
            await asyncio.gather(sending, *self._asking, return_exceptions=True)

    async def _send(self, viewer: Viewer) -> None:
        await self._cockpit.asker.learn()
        viewer.outbox.put("hello", encoded(self._cockpit.hello(viewer)))

        async def send(message: str | bytes) -> None:
            kind = "text" if isinstance(message, str) else "bytes"
            await self._socket.send({"type": "websocket.send", kind: message})

        with suppress(WebSocketDisconnect, RuntimeError):  # the page has gone; the receiver notices, too
            await viewer.outbox.run(send)

    # --- orders -----------------------------------------------------------------------------------

    def _obey(self, order: LiveOrder, viewer: Viewer) -> None:
        if isinstance(order, Stop):  # before anything else
            if self._gate.allows(self._visitor, "stop"):
                stopping = self._cockpit.stopper.stop(self._visitor.name)
                self._spawn(self._answer_stop(order, stopping, viewer))
            return
        if not self._gate.allows(self._visitor, RIGHTS.get(type(order), "look")):
            self._refuse(order, viewer, "you may look and stop, and not operate: ask for the role of an operator")
        elif isinstance(order, Seen):
            viewer.looking.seen(order.stamp_ns, asyncio.get_running_loop().time())
        elif isinstance(order, Drive):
            self._driver.move(order)
        elif isinstance(order, Look):
            viewer.looking.on = order.on
            self._cockpit.attend()
        elif isinstance(order, Log):
            self._cockpit.want_log(viewer, order.on)
        elif len(self._asking) >= AT_ONCE:
            self._refuse(order, viewer, f"{AT_ONCE} requests of this page are still under way: wait for an answer")
        else:
            self._spawn(self._answer(order, viewer))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.ensure_future(work)
        self._asking.add(task)
        task.add_done_callback(self._asking.discard)

    async def _answer(self, order: Run | Cancel | Reset | What | BeginDrive | EndDrive, viewer: Viewer) -> None:
        asker = self._cockpit.asker
        if isinstance(order, Run):
            reply = await asker.run(order.task, instead=order.instead)
        elif isinstance(order, Cancel):
            reply = await asker.cancel()
        elif isinstance(order, Reset):
            reply = await asker.reset(self._visitor.name)
        elif isinstance(order, BeginDrive):
            reply = await self._driver.begin(instead=order.instead)
        elif isinstance(order, EndDrive):
            reply = await self._driver.end()
        else:
            reply = what(order, self._cockpit.scene)
        viewer.outbox.reply(reply_text(order.id, reply))

    async def _answer_stop(self, order: Stop, stopping: asyncio.Task[dict[str, Any]], viewer: Viewer) -> None:
        viewer.outbox.reply(stop_reply(order.id, await asyncio.shield(stopping)))

    def _refuse(self, order: Order, viewer: Viewer, text: str) -> None:
        id: Id | None = getattr(order, "id", None)
        if id is not None:
            viewer.outbox.reply(reply_text(id, Reply(False, text)))
