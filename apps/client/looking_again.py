"""Finds a task again with whose executive the contact was lost, to report the task's true end."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager, suppress
from typing import Generic, TypeVar

from cocoro.contact import Contact
from cocoro.errors import CocoroError
from cocoro.messages import ReportRequest, TaskState
from cocoro.participant import Participant
from cocoro.topics import REPORT
from deploy.contact import RECOVERY_S

P = TypeVar("P", bound=Participant)

EXECUTIVE = "executive"
LOOK_S = 0.2
"""Time between two looks whether the executive has died or is heard again."""
REJOIN_S = 2.0
"""After so long without contact the mesh is joined anew, by another session, and so often again."""
LIVING_S = 60.0
"""Time for which the client looks for an executive whose process lives. One that may have died is looked for during
RECOVERY_S."""
LATE_S = 5.0
"""After so long without news of the task the executive is asked for it; it tells the task's state 5 times a second."""

Rejoin = Callable[[], AbstractAsyncContextManager[P]]


class LostTaskError(Exception):
    """The outcome of the task is not known; the text says why."""


class LookingAgain(Generic[P]):
    """Asks the executive for one task, over the present link or a fresh one."""

    def __init__(self, link: P, contact: Contact, rejoin: Rejoin[P] | None) -> None:
        self.link = link
        """The link over which the executive was heard last."""
        self._contact = contact
        self._rejoin = rejoin
        self._joined: AbstractAsyncContextManager[P] | None = None

    async def ask(self, task_id: str, link: P | None = None) -> TaskState | None:
        """The task's state by the executive; None when it does not answer. Raises LostTaskError when it does not know
        the task: it has restarted."""
        try:
            state = await (link or self.link).call(REPORT, ReportRequest(task_id=task_id))
        except CocoroError:
            return None
        if state.task_id != task_id:
            raise LostTaskError("the executive was restarted meanwhile and does not know the task")
        return state

    async def find(self, task_id: str, lost: str, heard: Callable[[float], Awaitable[bool]]) -> TaskState:
        """Waits for the executive and returns the task's state by it. `heard(s)` waits for a sign of it, at most `s`.

        Raises LostTaskError, with a text that begins with `lost`, when the executive is not found in time.
        """
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        rejoin_s = begun_s + REJOIN_S
        while True:
            now_s = loop.time()
            if self._contact.dead(EXECUTIVE):
                raise LostTaskError(f"{EXECUTIVE} died")
            lives = self._contact.lives(EXECUTIVE)
            if now_s - begun_s >= (LIVING_S if lives else RECOVERY_S):
                for_s = f" for {LIVING_S:g} s, though its process lives" if lives else ""
                raise LostTaskError(f"{lost}{for_s}; the task may still be running; see cocoro status")
            if await heard(LOOK_S) and (state := await self.ask(task_id)) is not None:
                return state
            if self._rejoin is not None and now_s >= rejoin_s:
                rejoin_s = now_s + REJOIN_S
                if (state := await self._over_a_fresh_link(task_id)) is not None:
                    return state

    async def _over_a_fresh_link(self, task_id: str) -> TaskState | None:
        assert self._rejoin is not None
        await self.close()
        with suppress(CocoroError):
            joined = self._rejoin()
            link = await joined.__aenter__()
            self._joined = joined
            if (state := await self.ask(task_id, link)) is not None:
                self.link = link
                return state
        await self.close()
        return None

    async def close(self) -> None:
        joined, self._joined = self._joined, None
        if joined is not None:
            await joined.__aexit__(None, None, None)
