"""Driving by hand from a page: passes its motions on to the executive, and the executive's ticks back to it.

Nothing here holds a motion up or repeats one. The tick that a motion quotes comes from the page, so a motion that
waited anywhere on its way moves nothing.
"""

from __future__ import annotations

import asyncio

from cocoro.errors import CocoroError
from cocoro.messages import DriveReply, DriveRequest
from cocoro.topics import DRIVE
from services.cockpit.asking import Reply
from services.cockpit.cockpit import Cockpit, Viewer
from services.cockpit.orders import Drive
from services.cockpit.scene import DRIVE_TASK, encoded


class Driver:
    """One page that may drive."""

    def __init__(self, cockpit: Cockpit, viewer: Viewer) -> None:
        self._cockpit = cockpit
        self._viewer = viewer
        self._task_id = ""
        self._next: Drive | None = None
        """The newest motion, while the one before it is under way."""
        self._moving: asyncio.Task[None] | None = None

    async def begin(self, *, instead: bool) -> Reply:
        """Take the robot. The first tick follows the answer."""
        reply = await self._cockpit.asker.run({"task": DRIVE_TASK}, instead=instead, with_us=True)
        if reply.ok and reply.data is not None:
            self._task_id = str(reply.data["task_id"])
            self.move(Drive())
        return reply

    async def end(self) -> Reply:
        """Let go of it."""
        task_id, self._task_id = self._task(), ""
        return await self._cockpit.asker.cancel(task_id) if task_id else Reply(False, "nobody drives by hand")

    def move(self, order: Drive) -> None:
        """Pass a motion on; while one is under way the newest waits, in place of those before it."""
        self._next = order
        if self._moving is None or self._moving.done():
            self._moving = asyncio.ensure_future(self._move())

    def close(self) -> None:
        """The page has gone. What moved comes to rest, since nothing quotes the next tick; and the task that this page
        began ends, so that the robot is free for others."""
        if self._moving is not None:
            self._moving.cancel()
        if self._task_id:
            self._cockpit.node.spawn(self._leave(self._task_id))

    async def _leave(self, task_id: str) -> None:
        await self._cockpit.asker.cancel(task_id)

    async def _move(self) -> None:
        while (order := self._next) is not None:
            self._next = None
            await self._ask(order)

    async def _ask(self, order: Drive) -> None:
        task_id = self._task()
        if not task_id:
            self._tell(DriveReply(accepted=False, refusal="no_task", text="nobody drives by hand: begin it first"))
            return
        try:
            request = DriveRequest(task_id=task_id, tick=order.tick, motion=order.motion)
            self._tell(await self._cockpit.node.call(DRIVE, request))
        except CocoroError as error:  # the old tick moves nothing any more, but shows who asks
            self._tell(DriveReply(accepted=False, tick=order.tick, text=str(error)))

    def _task(self) -> str:
        """The task in which this page drives: the one that it began, or the one that runs."""
        scene = self._cockpit.scene
        if scene.drives:
            return scene.task.task_id
        return self._task_id

    def _tell(self, reply: DriveReply) -> None:
        told = {"tick": reply.tick, "accepted": reply.accepted, "refusal": reply.refusal, "text": reply.text}
        self._viewer.outbox.put("tick", encoded({"kind": "tick"} | told))
