"""A task on the robot, for programs: await it, iterate over its progress, cancel it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, Generator
from typing import Any

import msgspec

from apps.client.task_run import CANCEL_S, EXECUTIVE, LostTaskError, TaskRun, Watcher
from cocoro.contact import Contact
from cocoro.messages import Phase, TaskRequest, TaskState
from cocoro.participant import Participant
from cocoro.task_errors import NoTaskError, TaskCancelledError, TaskLostError, ending, refusal

log = logging.getLogger("cocoro.client")
BEFORE = "before it began"
PATIENCE_S = CANCEL_S + 2.0
"""Longest wait for the end of a task that is cancelled; a request may take 2 s."""
NOT_CANCELLED = "the task does not end; robot.stop() or `cocoro stop` stops the robot"


class TaskResult(msgspec.Struct, frozen=True, kw_only=True):
    """A task that is done."""

    task_id: str
    task: str
    label: str
    """The object that it concerned; '' for none."""
    elapsed_s: float
    phases: tuple[Phase, ...]
    measures: dict[str, float]
    """The task's own figures on how well it went, by name."""
    reason: str
    """What the task says of its end, a word, a colon and a sentence; '' for most."""
    recorded_in: str
    """The capture's file on the robot's computer; '' when no recorder has told."""


class TaskHandle(Watcher):
    """One task. `await` it for its `TaskResult`; `async for` gives its states as they come.

    Both raise a `TaskRefusedError` when the robot does not start the task, and a `TaskEndedError` when it ends and is
    not done. Whoever awaits it and is cancelled meanwhile (Ctrl-C, a time-out) cancels the task on the robot, unless it
    is detached. As a context manager it cancels what still runs at the end of the block.
    """

    def __init__(
        self,
        participant: Participant,
        request: TaskRequest | None,
        *,
        contact: Contact | None = None,
        detached: bool = False,
        attended: TaskState | None = None,
    ) -> None:
        """`attended`: the state of a task that runs already; then without a request."""
        self.detached = detached
        self.state: TaskState | None = attended
        """The newest state; None before the first."""
        self._read = False
        """Whether anybody was told how it ended."""
        self._waiting: list[asyncio.Queue[TaskState | None]] = []
        self._accepted: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._accepted.add_done_callback(_retrieved)
        self._run = TaskRun(participant, request, self, contact or Contact(), watched=not detached)
        if attended is not None:
            self._run.attend(attended)
        self._work = asyncio.ensure_future(self._carry_out(attended))
        self._work.add_done_callback(_retrieved)

    @property
    def name(self) -> str:
        """The task and its object, for people."""
        return self._run.named

    @property
    def task_id(self) -> str:
        """The id that the robot gave it; '' before it was accepted."""
        return self._run.task_id

    @property
    def done(self) -> bool:
        """Whether it is over, however it ended."""
        return self._work.done()

    def __repr__(self) -> str:
        state = self.state
        now = "asked for" if state is None else state.outcome or f"{state.phase}, {state.elapsed_s:.1f} s"
        return f"<{self.name}: {now}>"

    # --- waiting ----------------------------------------------------------------------------------

    async def accepted(self) -> str:
        """Waits until the robot has begun the task; returns its id. Raises TaskRefusedError, MeshError."""
        self._read = True
        await asyncio.wait((self._accepted,))
        if self._accepted.cancelled():
            raise self._closed()
        return self._accepted.result()

    def __await__(self) -> Generator[Any, None, TaskResult]:
        return self._result().__await__()

    async def _result(self) -> TaskResult:
        self._read = True
        try:
            await asyncio.wait((self._work,))
        except asyncio.CancelledError:
            if not self.detached:
                self._run.let_go()
            raise
        if self._work.cancelled():
            raise self._closed()
        return self._work.result()

    async def __aiter__(self) -> AsyncGenerator[TaskState, None]:
        """Each state from now on, the newest known one first; the last one has its outcome."""
        states: asyncio.Queue[TaskState | None] = asyncio.Queue()
        if self.state is not None:
            states.put_nowait(self.state)
        if self._work.done():
            states.put_nowait(None)
        self._waiting.append(states)
        try:
            while (state := await self._next(states)) is not None:
                yield state
        finally:
            self._waiting.remove(states)
        await self._result()

    async def _next(self, states: asyncio.Queue[TaskState | None]) -> TaskState | None:
        try:
            return await states.get()
        except asyncio.CancelledError:
            if not self.detached:
                self._run.let_go()
            raise

    # --- ending it --------------------------------------------------------------------------------

    async def cancel(self) -> TaskState | None:
        """Cancels it on the robot and waits until the robot stands; returns the last state, whatever its outcome. None
        when it never began. Raises TaskLostError when the robot does not end it in time."""
        self._run.let_go()
        self._read = True
        await asyncio.wait((self._work,), timeout=PATIENCE_S)
        if not self._work.done():
            raise TaskLostError(self._known, "not_cancelled", NOT_CANCELLED)
        error = None if self._work.cancelled() else self._work.exception()
        if isinstance(error, TaskLostError):
            raise error
        return self.state

    async def __aenter__(self) -> TaskHandle:
        return self

    async def __aexit__(self, *_: object) -> None:
        if not self.detached:
            await self.end()

    async def end(self) -> None:
        """Ends it with its client: cancels it unless it is detached, and waits for its outcome, but not for ever."""
        if not self._work.done() and not self.detached:
            self._run.let_go()
            await asyncio.wait((self._work,), timeout=PATIENCE_S)
        self._work.cancel()
        await asyncio.wait((self._work,))
        error = None if self._work.cancelled() else self._work.exception()
        if error is not None and not self._read:
            log.warning("nobody waited for %s, which ended so: %s", self.name, error)

    # --- the work ---------------------------------------------------------------------------------

    async def _carry_out(self, attended: TaskState | None) -> TaskResult:
        try:
            return await (self._follow_from(attended) if attended is not None else self._from_request())
        except Exception as error:
            if not self._accepted.done():
                self._accepted.set_exception(error)
            raise
        finally:
            self._accepted.cancel()
            self._run.close()
            for states in self._waiting:
                states.put_nowait(None)

    async def _from_request(self) -> TaskResult:
        self._run.listen()  # before the request, so that no state is missed
        if not self.detached:
            self._run.be_present()
        reply = await self._run.request()
        if reply is None:
            raise TaskCancelledError(self._known, "cancelled", BEFORE)
        if not reply.accepted:
            raise refusal(reply)
        self._accepted.set_result(reply.task_id)
        return await self._followed()

    async def _follow_from(self, state: TaskState) -> TaskResult:
        self._run.listen()
        self._accepted.set_result(state.task_id)
        return self._result_of(state) if state.outcome is not None else await self._followed()

    async def _followed(self) -> TaskResult:
        try:
            return self._result_of(await self._run.follow())
        except LostTaskError as lost:
            died = self._run.contact.dead(EXECUTIVE)
            raise TaskLostError(self._known, "died" if died else "lost_contact", str(lost)) from lost

    def _result_of(self, state: TaskState) -> TaskResult:
        if state.outcome != "done":
            raise ending(state)
        return TaskResult(
            task_id=state.task_id, task=state.task, label=state.label, elapsed_s=state.elapsed_s, phases=state.phases,
            measures=state.measures, reason=state.reason, recorded_in=self._run.file,
        )  # fmt: skip

    @property
    def _known(self) -> TaskState:
        """The newest state, or what was asked for."""
        return self.state or TaskState(task_id=self.task_id, task=self._run.task, label=self._run.label)

    def _closed(self) -> TaskLostError:
        return TaskLostError(self._known, "client_closed", "the client was closed before the task was over")

    # --- as the watcher of its run ----------------------------------------------------------------

    async def hear(self, state: TaskState) -> None:
        self.state = state
        for states in self._waiting:
            states.put_nowait(state)

    def say(self, text: str) -> None:
        log.warning("%s: %s", self.name, text)


def unknown_task(robot: str, task_id: str) -> NoTaskError:
    """The error for a task that the executive does not know."""
    return NoTaskError(
        f"{robot}: the executive knows no task {task_id}: it has restarted since, or the name is wrong"
        if task_id
        else f"{robot}: no task has run since the executive started",
        "no_task",
    )


def _retrieved(future: asyncio.Future[Any]) -> None:
    """Whoever waits gets the error; `end` reports it where nobody does."""
    if not future.cancelled():
        future.exception()
