"""Drive a robot by hand: the client's side of the requests that carry an operator's motion.

    reply = await begin(participant, instead=True)
    async with Driving(participant, reply.task_id) as driving:
        driving.motion = Motion(speed_mps=0.3)  # counts for 0.2 s: set it again while the control is held
        ...

Each answer of the executive brings a tick, which the next request quotes. A motion counts only with a tick of at most
0.2 s, so a request that waited anywhere moves nothing, and a robot whose driver is cut off comes to rest.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from types import TracebackType

from cocoro.errors import CocoroError
from cocoro.messages import DriveReply, DriveRequest, Motion, TaskReply, TaskRequest
from cocoro.messages.driving import HOLD_S
from cocoro.participant import Participant
from cocoro.topics import DRIVE, RUN

TASK = "drive"
"""The name of the task that lets an operator drive."""
RATE_HZ = 25.0
"""Requests while a control is held."""
IDLE_S = 0.5
"""Time between two requests while no control is held; they only show whether the task still runs."""
BEGIN_S = 6.0
"""Wait for the answer to `begin`, which takes the robot's place of rest first where a task runs."""


async def begin(participant: Participant, *, asker: str = "", instead: bool = False) -> TaskReply:
    """Ask for the task `drive`. `asker`: as in `TaskRequest`; `instead`: end the running task first. Raises MeshError
    when no executive answers."""
    request = TaskRequest(task={"task": TASK}, asker=asker, instead=instead)
    return await participant.call(RUN, request, BEGIN_S if instead else None)


class Driving:
    """One driver of a running task `drive`. Use it as an asynchronous context manager.

    Two drivers of one task do not mix: who moves the robot has it until he has let go for a second; the other's motion
    is refused meanwhile (`refusal` is `other_driver`).
    """

    def __init__(self, participant: Participant, task_id: str, *, rate_hz: float = RATE_HZ) -> None:
        self.task_id = task_id
        self.reply = DriveReply(accepted=False)
        """The executive's last answer."""
        self.trouble = ""
        """Why the last request had no answer; empty when it had one."""
        self.over = asyncio.Event()
        """Set when the task does not run any more; `reply.text` says why."""
        self._participant = participant
        self._period_s = 1.0 / rate_hz
        self._motion = Motion()
        self._held_until_s = 0.0
        self._moved = False
        """Whether the last request asked for motion."""
        self._news = asyncio.Event()
        self._work: asyncio.Task[None] | None = None

    @property
    def motion(self) -> Motion:
        """What is asked for now; rest when the last motion has expired."""
        held = asyncio.get_running_loop().time() < self._held_until_s
        return self._motion if held else Motion()

    @motion.setter
    def motion(self, wanted: Motion) -> None:
        """Ask for a motion for the next 0.2 s, or with `Motion()` for rest at once."""
        changed = self.motion.zero != wanted.zero
        self._motion = wanted
        self._held_until_s = asyncio.get_running_loop().time() + HOLD_S
        if changed:
            self._news.set()  # begin and rest wait for no period

    async def __aenter__(self) -> Driving:
        self._work = asyncio.create_task(self._run())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._work is not None:
            self._work.cancel()
            await asyncio.gather(self._work, return_exceptions=True)
        if self._moved and not self.over.is_set():
            await self._ask(Motion())

    async def _run(self) -> None:
        while not self.over.is_set():
            begun_s = asyncio.get_running_loop().time()
            self._news.clear()
            motion = self.motion
            await self._ask(motion)
            if self._moved and not motion.zero and self.reply.refusal == "no_tick" and not self.trouble:
                await self._ask(self.motion)  # the first motion after a pause: now there is a tick
            took_s = asyncio.get_running_loop().time() - begun_s
            wait_s = max(self._period_s - took_s, 0.0) if self._moved else IDLE_S
            # Python 3.11's `wait_for` loses a cancellation that comes together with the news.
            with suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._news.wait()

    async def _ask(self, motion: Motion) -> None:
        request = DriveRequest(task_id=self.task_id, tick=self.reply.tick, motion=motion)
        self._moved = not motion.zero
        try:
            self.reply = await self._participant.call(DRIVE, request)
            self.trouble = ""
        except CocoroError as error:
            # The old tick moves nothing any more, but shows who asks.
            self.reply, self.trouble = DriveReply(accepted=False, tick=self.reply.tick), str(error)
        if self.reply.refusal == "no_task":
            self.over.set()
