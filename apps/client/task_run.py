"""One task on a robot, from its request to its outcome: what commands and programs that run tasks stand on.

It prints nothing. Who uses it hears of each state, of what has to be said to people, and gets the robot's replies.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Generic, TypeVar

import msgspec

from apps.client.looking_again import EXECUTIVE, LATE_S, LookingAgain, LostTaskError, P, Rejoin
from cocoro.bus.base import Handle
from cocoro.contact import Contact
from cocoro.driving import BEGIN_S
from cocoro.errors import CallTimeoutError, CocoroError
from cocoro.keys import asker_key
from cocoro.messages import CancelRequest, Message, TaskReply, TaskRequest, TaskState
from cocoro.tasks import Task
from cocoro.topics import CANCEL, LATCH, RECORDING, RUN, TASK, Topic

__all__ = ["EXECUTIVE", "LostTaskError", "Rejoin", "TaskRun"]

M = TypeVar("M", bound=Message)

UNSETTLED_S = {"not_alive": 3.0, "estop": 10.0, "asker_gone": 3.0}
"""Longest time for which such a refusal is answered by another request: an executive that has just started may not have
received every service's state, and a late one not this client's token. A stop that is known to be latched is not asked
about again."""
ASK_AGAIN_S = 0.1
"""Time between two of these requests."""
CANCEL_S = 10.0
"""Wait for the outcome of a cancelled task, before it is said that there is none."""
RECORDER = "capture"


class Watcher:
    """What who runs a task wants to hear of it. By default nothing."""

    async def hear(self, state: TaskState) -> None:
        """A state of the task, in order; the last one has its outcome."""

    def say(self, text: str) -> None:
        """Something that a person should know."""

    def cancelling(self) -> None:
        """The robot is being asked to cancel the task."""


class TaskRun(Generic[P]):
    """One task. While it is `present`, the executive cancels the task when this process has gone, however that ends."""

    def __init__(
        self,
        link: P,
        request: TaskRequest | None,
        watcher: Watcher,
        contact: Contact,
        *,
        watched: bool = True,
        rejoin: Rejoin[P] | None = None,
    ) -> None:
        """`request` is None for a task that is only attended. `contact` finds out what happened to an executive that is
        not heard, and `rejoin` joins its mesh anew. With `watched=False` the task outlives this process."""
        task = None if request is None else request.task
        self.link = link
        """The link over which the executive was heard last."""
        self.contact = contact
        self.task = task.name if isinstance(task, Task) else "" if task is None else str(task.get("task", ""))
        self.label = task.target if isinstance(task, Task) else "" if task is None else str(task.get("label", ""))
        self.task_id = ""
        self._looking = LookingAgain(link, contact, rejoin)
        self._request = request
        self._watched = watched
        self._watcher = watcher
        self._begun = False
        """Whether any state of the task was heard."""
        self._token: Handle | None = None
        self._news: asyncio.Queue[TaskState | bool] = asyncio.Queue()
        """States of the task, and whether the executive's liveliness token is present, at each change."""
        self._files: dict[str, str] = {}
        """The file in which a task is recorded, by its id."""
        self._listening = ExitStack()
        self._let_go = asyncio.Event()

    @property
    def named(self) -> str:
        """The task and its object, for people."""
        return f"{self.task} {self.label}".strip()

    @property
    def file(self) -> str:
        """The file in which the task is recorded; '' when no recorder has told."""
        return self._files.get(self.task_id, "")

    @property
    def is_let_go(self) -> bool:
        return self._let_go.is_set()

    def let_go(self) -> None:
        """Cancels the task on the robot, or does not request it; `follow` then returns its outcome."""
        self._let_go.set()

    # --- listening --------------------------------------------------------------------------------

    def listen(self) -> None:
        """Keeps the states of tasks from now on. Call it before the task is requested, so that no state is missed."""
        self._hear(TASK, self._news.put_nowait)
        self._hear(RECORDING.of(RECORDER), lambda recording: self._files.update({recording.task_id: recording.file}))

    def _hear(self, topic: Topic[M], reader: Callable[[M], None]) -> None:
        def take(_key: str, message: M) -> None:
            reader(message)

        inbox = self.link.inbox(topic)
        inbox.add(take)
        self._listening.callback(inbox.remove, take)

    def close(self) -> None:
        """Ends the listening, and the presence."""
        self._listening.close()
        self.leave()

    # --- the request ------------------------------------------------------------------------------

    def be_present(self) -> None:
        """Has the executive watch this process: declares its token, and names it in the request."""
        assert self._request is not None
        asker = f"operator-{self.link.bus.new_incarnation():x}"
        self._token = self.link.bus.declare_alive(asker_key(self.link.robot_name, asker))
        self._request = msgspec.structs.replace(self._request, asker=asker)

    def leave(self) -> None:
        """Drops the token."""
        if self._token is not None:
            self._token.close()
            self._token = None

    async def request(self) -> TaskReply | None:
        """Requests the task, repeatedly for a short time when the robot has only just started; None when somebody let
        go of it before it was accepted. Raises MeshError when no executive answers."""
        assert self._request is not None
        latch = self.link.latest(LATCH)
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        patience_of_call_s = BEGIN_S if self._request.instead else None
        try:
            while not self._let_go.is_set():
                reply = await self.link.call(RUN, self._request, patience_of_call_s)
                latched = latch.value is not None and latch.value.state == "latched"
                patience_s = 0.0 if reply.accepted or latched else UNSETTLED_S.get(reply.refusal or "", 0.0)
                if loop.time() - begun_s >= patience_s:
                    self.task_id = reply.task_id
                    return reply
                with suppress(TimeoutError):
                    async with asyncio.timeout(ASK_AGAIN_S):
                        await self._let_go.wait()
            return None
        finally:
            latch.close()

    def attend(self, state: TaskState) -> None:
        """Takes a task that runs already."""
        self.task, self.label, self.task_id, self._begun = state.task, state.label, state.task_id, True

    # --- the task ---------------------------------------------------------------------------------

    async def follow(self) -> TaskState:
        """The accepted task's last state, with its outcome. Raises LostTaskError when it cannot be known."""
        alive = self.link.watch_alive(self._on_alive, EXECUTIVE)
        beside = [asyncio.create_task(self._cancel_when_let_go())]
        if self.contact.keeps:
            beside.append(asyncio.create_task(self.contact.keep()))
        try:
            return await self._until_over()
        finally:
            alive.close()
            for task in beside:
                task.cancel()
            await self._looking.close()

    def _on_alive(self, _service: str, alive: bool) -> None:
        if alive:
            self.contact.met(EXECUTIVE)
        self._news.put_nowait(alive)

    async def _until_over(self) -> TaskState:
        while True:
            news = await self._next_news()
            state = await self._looked_for() if news is False else news
            if isinstance(state, bool):
                continue
            if state.task_id != self.task_id:
                # One task runs at a time: once this one has begun, news of another means that its end was not heard.
                over = await self._looking.ask(self.task_id) if self._begun else None
                if over is None:
                    continue
                state = over
            self._begun = True
            await self._watcher.hear(state)
            if state.outcome is not None:
                return state

    async def _looked_for(self) -> TaskState:
        """The task's state after the executive's token was lost. Raises LostTaskError."""
        lost = await self.contact.lost(EXECUTIVE)
        if not self.contact.dead(EXECUTIVE):
            self._watcher.say(f"{lost}: looking again")
        state = await self._looking.find(self.task_id, lost, self._heard)
        if self._looking.link is not self.link:
            self.link = self._looking.link
            self.listen()
            self.link.watch_alive(self._on_alive, EXECUTIVE)
        return state

    async def _heard(self, timeout_s: float) -> bool:
        """Waits for a sign of the executive; its state of the task is asked for then, since some may have been lost."""
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                return await self._news.get() is not False
        return False

    async def _next_news(self) -> TaskState | bool:
        """The next news to arrive; the executive's answer when none arrives for long although it is present."""
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(LATE_S):  # `wait_for` may swallow a cancellation that comes with news
                    return await self._news.get()
            if (state := await self._looking.ask(self.task_id)) is not None:
                return state

    # --- its end from here ------------------------------------------------------------------------

    async def _cancel_when_let_go(self) -> None:
        await self._let_go.wait()
        cancelling = asyncio.ensure_future(self.cancel_on_robot())
        await asyncio.sleep(0)  # cancel first, then write: a terminal that has gone must not come in between
        self._watcher.cancelling()
        trouble = await cancelling
        if not trouble:
            await asyncio.sleep(CANCEL_S)
            trouble = "the task does not end; `cocoro estop` stops the robot"
        self._watcher.say(trouble)

    async def cancel_on_robot(self) -> str:
        """Returns what was wrong; empty when the executive cancels the task."""
        try:
            reply = await self.link.call(CANCEL, CancelRequest(task_id=self.task_id))
        except CocoroError as error:
            self.leave()  # the other way to the same end
            late = isinstance(error, CallTimeoutError)
            return (
                "the executive does not answer; `cocoro estop` stops the robot" if late else f"not cancelled: {error}"
            )
        return "" if reply.accepted else f"not cancelled: {reply.text}"
