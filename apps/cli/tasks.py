"""Follows a task on a robot: requests it from the executive, shows its progress, cancels it, reports its outcome."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import Coroutine
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from apps.cli import exits
from apps.cli.link import MeshLink
from apps.cli.looking_again import EXECUTIVE, LATE_S, LookingAgain, LostTaskError, Rejoin
from apps.cli.output import complain, json_error
from apps.cli.progress import TaskDisplay
from apps.cli.snapshot import SnapshotTaker
from cocoro.bus.base import Handle
from cocoro.driving import BEGIN_S
from cocoro.errors import CallTimeoutError, CocoroError
from cocoro.messages import CancelRequest, TaskReply, TaskRequest, TaskState
from cocoro.tasks import Task
from cocoro.topics import CANCEL, LATCH, RECORDING, RUN, TASK
from deploy.contact import ProcessContact
from deploy.processor import ProcessorWatch
from services.executive.askers import asker_key

UNSETTLED_S = {"not_alive": 3.0, "estop": 10.0, "asker_gone": 3.0}
"""Longest time for which such a refusal is answered by another request: an executive that has just started may not have
received every service's state, and a late one not this command's token. A stop that is known to be latched is not asked
about again."""
ASK_AGAIN_S = 0.1
"""Time between two of these requests."""
CANCEL_S = 10.0
"""Wait for the outcome of a cancelled task, before a line says that there is none."""
RECORDER = "capture"
Result = tuple[int, dict[str, object]]
"""Exit code, and the result as data."""


class Follower:
    """Requests one task and follows it to its outcome. On every way out before the outcome the task is cancelled: by a
    request, and by the executive, which sees the liveliness token of this process vanish."""

    def __init__(
        self,
        link: MeshLink,
        request: TaskRequest | None,
        view: TaskDisplay,
        picture: Path | None,
        contact: ProcessContact | None = None,
        *,
        watched: bool = True,
        rejoin: Rejoin | None = None,
    ) -> None:
        """`request` is None for a task that is only attended. `contact` finds out what happened to an executive that is
        not heard, and `rejoin` joins its mesh anew. With `watched=False` the task outlives this process."""
        self._contact = contact or ProcessContact(link.run_dir.claimant_pid)
        self._looking = LookingAgain(link, self._contact, rejoin)
        self._processor = ProcessorWatch()
        self._link = link
        self._request = request
        self._watched = watched
        self._view = view
        self._picture = picture
        task: Task | None = None if request is None else request.task
        self._task = "" if task is None else task.name
        self._label = "" if task is None else task.target
        self._snapshot_phase = "" if task is None else task.snapshot_phase
        self._task_id = ""
        self._begun = False
        """Whether any state of the task was heard."""
        self._token: Handle | None = None
        self._news: asyncio.Queue[TaskState | bool] = asyncio.Queue()
        """States of the task, and whether the executive's liveliness token is present, at each change."""
        self._files: dict[str, str] = {}
        """The file in which a task is recorded, by its id."""
        self._let_go = asyncio.Event()
        self._left = asyncio.Event()
        self._signals = 0

    def signalled(self, number: signal.Signals) -> None:
        """Handles a signal: the first cancels the task on the robot, a second one ends the command. A terminal that is
        closed may send several, which count as one."""
        if number is not signal.SIGHUP:
            self._signals += 1
        if self._signals > 1:
            self.leave()
        self.cancel()

    def cancel(self) -> None:
        """Cancels the task on the robot; `run` then returns its outcome."""
        self._let_go.set()

    def leave(self) -> None:
        """Makes `run` return without the task's outcome."""
        self._left.set()

    async def run(self) -> Result:
        """Runs the task; returns the exit code and the result as data."""
        self.listen()  # before the request, so that no state is missed
        return await self._unless_left(self._run())

    async def ask(self) -> Result:
        """Requests the task without following it; returns the exit code and the result as data. Cannot be left: nobody
        watches the task, and whoever lets go of it before the answer must not find it running."""
        return await self._begin()

    def listen(self) -> None:
        """Keeps the states of tasks from now on."""
        self._link.inbox(TASK).add(lambda _key, state: self._news.put_nowait(state))
        self._link.inbox(RECORDING.of(RECORDER)).add(
            lambda _key, state: self._files.update({state.task_id: state.file})
        )

    async def attend(self, state: TaskState) -> Result:
        """Follows a task that runs already, or has ended; returns the exit code and the result as data."""
        self._task, self._label, self._task_id, self._begun = state.task, state.label, state.task_id, True
        if state.outcome is not None:
            return self._outcome(state)
        return await self._unless_left(self._follow())

    @property
    def _named(self) -> dict[str, object]:
        return {"task_id": self._task_id, "task": self._task, "label": self._label}

    @property
    def _name(self) -> str:
        return f"{self._task} {self._label}".strip()

    async def _unless_left(self, work: Coroutine[Any, Any, Result]) -> Result:
        working, left = asyncio.ensure_future(work), asyncio.ensure_future(self._left.wait())
        try:
            await asyncio.wait((working, left), return_when=asyncio.FIRST_COMPLETED)
            return working.result() if working.done() else (exits.REFUSED, self._unfinished())
        finally:
            left.cancel()
            working.cancel()
            await asyncio.gather(working, return_exceptions=True)

    def _unfinished(self) -> dict[str, object]:
        """The result of a command that ended before its task."""
        reason = "left: the command ended before the task did; `cocoro wait` reports its outcome"
        print(f"cocoro: {reason.partition(': ')[2]}", file=sys.stderr)
        return {**self._named, "outcome": None, "reason": reason}

    async def _run(self) -> Result:
        if self._watched:
            asker = f"operator-{self._link.bus.new_incarnation():x}"
            self._token = self._link.bus.declare_alive(asker_key(self._link.robot, asker))
            assert self._request is not None
            self._request = msgspec.structs.replace(self._request, asker=asker)
        try:
            code, result = await self._begin()
            return await self._follow() if code == exits.DONE else (code, result)
        finally:
            self._drop_token()

    def _drop_token(self) -> None:
        if self._token is not None:
            self._token.close()
            self._token = None

    async def _begin(self) -> Result:
        """Requests the task; the code is DONE when it is accepted and nobody has let go of it meanwhile."""
        reply = await self._ask()
        if reply is None:
            self._view.result(f"cancelled: {self._name} before it began")
            return exits.REFUSED, {**self._named, "outcome": "cancelled", "reason": "before it began"}
        if not reply.accepted:
            return self._refused(reply)
        self._task_id = reply.task_id
        if self._let_go.is_set() and not self._watched:
            await self._cancel_on_robot()
            return exits.REFUSED, {**self._named, "outcome": "cancelled", "reason": "by the operator"}
        return exits.DONE, {**self._named, "outcome": None}

    async def _follow(self) -> Result:
        alive = self._link.watch_alive(self._on_alive, EXECUTIVE)
        beside = [asyncio.create_task(self._cancel_when_let_go())]
        if self._contact.keeps:
            beside.append(asyncio.create_task(self._contact.keep()))
        self._processor.take(self._processes())
        try:
            return self._outcome(await self._until_over())
        except LostTaskError as lost:
            return self._unknown(str(lost))
        finally:
            self._view.close()
            alive.close()
            for task in beside:
                task.cancel()
            await self._looking.close()

    def _on_alive(self, _service: str, alive: bool) -> None:
        if alive:
            self._contact.met(EXECUTIVE)
        self._news.put_nowait(alive)

    async def _ask(self) -> TaskReply | None:
        """Requests the task, repeatedly for a short time when the robot has only just started; None when somebody let
        go of it before it was accepted."""
        assert self._request is not None
        latch = self._link.latest(LATCH)
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        while not self._let_go.is_set():
            reply = await self._link.call(RUN, self._request, BEGIN_S if self._request.instead else None)
            latched = latch.value is not None and latch.value.state == "latched"
            patience_s = 0.0 if reply.accepted or latched else UNSETTLED_S.get(reply.refusal or "", 0.0)
            if loop.time() - begun_s >= patience_s:
                return reply
            with suppress(TimeoutError):
                await asyncio.wait_for(self._let_go.wait(), ASK_AGAIN_S)
        return None

    async def _until_over(self) -> TaskState:
        """The task's last state. Raises LostTaskError when it cannot be known."""
        camera: SnapshotTaker | None = None
        while True:
            news = await self._next_news()
            state = await self._looked_for() if news is False else news
            if isinstance(state, bool):
                continue
            if state.task_id != self._task_id:
                # One task runs at a time: once this one has begun, news of another means that its end was not heard.
                over = await self._looking.ask(self._task_id) if self._begun else None
                if over is None:
                    continue
                state = over
            self._begun = True
            if self._picture is not None:
                if state.phase == self._snapshot_phase and camera is None:
                    camera = SnapshotTaker(self._link)
                    camera.open()
                elif state.phase != self._snapshot_phase and camera is not None:
                    await self._take(camera, self._picture)
                    camera = None
            if state.outcome is not None:
                return state
            self._view.show(state)

    async def _looked_for(self) -> TaskState:
        """The task's state after the executive's token was lost. Raises LostTaskError."""
        lost = await self._contact.lost(EXECUTIVE)
        if not self._contact.dead(EXECUTIVE):
            self._view.say(f"{lost}: looking again")
        state = await self._looking.find(self._task_id, lost, self._heard)
        if self._looking.link is not self._link:
            self._link = self._looking.link
            self.listen()
            self._link.watch_alive(self._on_alive, EXECUTIVE)
        return state

    async def _heard(self, timeout_s: float) -> bool:
        """Waits for a sign of the executive; its state of the task is asked for then, since some may have been lost."""
        with suppress(TimeoutError):
            return await asyncio.wait_for(self._news.get(), timeout_s) is not False
        return False

    async def _next_news(self) -> TaskState | bool:
        """The next news to arrive; the executive's answer when none arrives for long although it is present."""
        while True:
            with suppress(TimeoutError):
                return await asyncio.wait_for(self._news.get(), LATE_S)
            if (state := await self._looking.ask(self._task_id)) is not None:
                return state

    async def _take(self, camera: SnapshotTaker, picture: Path) -> None:
        try:
            self._view.say(await camera.write(picture))
        except CocoroError as error:
            self._view.say(f"no picture: {error}")

    async def _cancel_when_let_go(self) -> None:
        await self._let_go.wait()
        cancelling = asyncio.ensure_future(self._cancel_on_robot())
        await asyncio.sleep(0)  # cancel first, then write: a terminal that has gone must not come in between
        self._view.say(f"cancelling {self._name} (Ctrl-C again ends without waiting)")
        trouble = await cancelling
        if not trouble:
            await asyncio.sleep(CANCEL_S)
            trouble = "the task does not end; `cocoro estop` stops the robot"
        self._view.say(trouble)

    async def _cancel_on_robot(self) -> str:
        """Returns what was wrong; empty when the executive cancels the task."""
        try:
            reply = await self._link.call(CANCEL, CancelRequest(task_id=self._task_id))
        except CocoroError as error:
            self._drop_token()  # the other way to the same end
            late = isinstance(error, CallTimeoutError)
            return (
                "the executive does not answer; `cocoro estop` stops the robot" if late else f"not cancelled: {error}"
            )
        return "" if reply.accepted else f"not cancelled: {reply.text}"

    # --- the end ----------------------------------------------------------------------------------

    def _refused(self, reply: TaskReply) -> Result:
        result = {"task": self._task, "label": self._label, "outcome": "refused"}
        complain(f"refused: {reply.text}")
        code = exits.USAGE if reply.refusal in exits.USAGE_REFUSALS else exits.REFUSED
        return code, result | {"reason": reply.refusal, "text": reply.text} | json_error(code, reply.text)

    def _outcome(self, state: TaskState) -> Result:
        code = {"done": exits.DONE, "failed": exits.FAILED, "cancelled": exits.REFUSED}[state.outcome or "failed"]
        time = f" {'in' if state.outcome == 'done' else 'after'} {state.elapsed_s:.1f} s" if state.elapsed_s else ""
        reason = f": {state.reason}" if state.reason and state.outcome != "done" else ""
        starved = self._starved() if state.outcome == "failed" else {}
        file = self._files.get(state.task_id, "")
        lines = [f"{state.outcome}: {self._name}{time}{reason}", *([f"recorded in {file}"] if file else [])]
        self._view.result("\n".join(lines))
        return code, msgspec.to_builtins(state) | {"recorded_in": file} | starved

    def _unknown(self, why: str) -> Result:
        """The result when the executive cannot tell the task's outcome. A task ends with its executive."""
        outcome = "failed" if self._contact.dead(EXECUTIVE) else "unknown"
        starved = self._starved()
        self._view.result(f"{outcome}: {self._name}: {why}")
        return exits.FAILED, {**self._named, "outcome": outcome, "reason": why, **starved}

    def _starved(self) -> dict[str, object]:
        """Says that this machine was short of processor time while the task ran, if it was; the same as data."""
        use = self._processor.take(self._processes())
        if use is None or not use.words:
            return {}
        self._view.say(use.words)
        return {"machine": use.words}

    def _processes(self) -> dict[str, int]:
        """The robot's processes of this machine."""
        with suppress(OSError, CocoroError):
            return {by.name: by.pid for by in self._link.run_dir.claims().values()}
        return {}
