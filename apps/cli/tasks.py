"""Follows a task on a robot for a command: shows its progress, cancels it, prints its outcome.

What becomes of the task is `apps.client.task_run`'s part.
"""

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
from apps.cli.output import complain, json_error
from apps.cli.progress import TaskDisplay
from apps.cli.snapshot import SnapshotTaker
from apps.client.task_run import EXECUTIVE, LostTaskError, Rejoin, TaskRun, Watcher
from cocoro.errors import CocoroError
from cocoro.messages import TaskReply, TaskRequest, TaskState
from deploy.contact import ProcessContact
from deploy.processor import ProcessorWatch

Result = tuple[int, dict[str, object]]
"""Exit code, and the result as data."""


class Follower(Watcher):
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
        rejoin: Rejoin[MeshLink] | None = None,
    ) -> None:
        """The arguments are those of `TaskRun`, but for the display and the last picture's file."""
        contact = contact or ProcessContact(link.run_dir.claimant_pid)
        self._task = TaskRun(link, request, self, contact, watched=watched, rejoin=rejoin)
        self._processor = ProcessorWatch()
        self._watched = watched
        self._view = view
        self._picture = picture
        self._snapshot_phase = "" if request is None else request.task.snapshot_phase
        self._camera: SnapshotTaker | None = None
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
        self._task.let_go()

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
        self._task.listen()

    async def attend(self, state: TaskState) -> Result:
        """Follows a task that runs already, or has ended; returns the exit code and the result as data."""
        self._task.attend(state)
        if state.outcome is not None:
            return self._outcome(state)
        return await self._unless_left(self._follow())

    @property
    def _named(self) -> dict[str, object]:
        return {"task_id": self._task.task_id, "task": self._task.task, "label": self._task.label}

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
            self._task.be_present()
        try:
            code, result = await self._begin()
            return await self._follow() if code == exits.DONE else (code, result)
        finally:
            self._task.leave()

    async def _begin(self) -> Result:
        """Requests the task; the code is DONE when it is accepted and nobody has let go of it meanwhile."""
        reply = await self._task.request()
        if reply is None:
            self._view.result(f"cancelled: {self._task.named} before it began")
            return exits.REFUSED, {**self._named, "outcome": "cancelled", "reason": "before it began"}
        if not reply.accepted:
            return self._refused(reply)
        if self._task.is_let_go and not self._watched:
            await self._task.cancel_on_robot()
            return exits.REFUSED, {**self._named, "outcome": "cancelled", "reason": "by the operator"}
        return exits.DONE, {**self._named, "outcome": None}

    async def _follow(self) -> Result:
        self._processor.take(self._processes())
        try:
            return self._outcome(await self._task.follow())
        except LostTaskError as lost:
            return self._unknown(str(lost))
        finally:
            self._view.close()

    # --- what is heard meanwhile ------------------------------------------------------------------

    async def hear(self, state: TaskState) -> None:
        if self._picture is not None:
            await self._look(state, self._picture)
        if state.outcome is None:
            self._view.show(state)

    def say(self, text: str) -> None:
        self._view.say(text)

    def cancelling(self) -> None:
        self._view.say(f"cancelling {self._task.named} (Ctrl-C again ends without waiting)")

    async def _look(self, state: TaskState, picture: Path) -> None:
        """Takes the picture at the end of the task's snapshot phase."""
        if state.phase == self._snapshot_phase and self._camera is None:
            self._camera = SnapshotTaker(self._task.link)
            self._camera.open()
        elif state.phase != self._snapshot_phase and self._camera is not None:
            camera, self._camera = self._camera, None
            try:
                self._view.say(await camera.write(picture))
            except CocoroError as error:
                self._view.say(f"no picture: {error}")

    # --- the end ----------------------------------------------------------------------------------

    def _refused(self, reply: TaskReply) -> Result:
        result = {"task": self._task.task, "label": self._task.label, "outcome": "refused"}
        complain(f"refused: {reply.text}")
        code = exits.USAGE if reply.refusal in exits.USAGE_REFUSALS else exits.REFUSED
        return code, result | {"reason": reply.refusal, "text": reply.text} | json_error(code, reply.text)

    def _outcome(self, state: TaskState) -> Result:
        code = {"done": exits.DONE, "failed": exits.FAILED, "cancelled": exits.REFUSED}[state.outcome or "failed"]
        time = f" {'in' if state.outcome == 'done' else 'after'} {state.elapsed_s:.1f} s" if state.elapsed_s else ""
        reason = f": {state.reason}" if state.reason and state.outcome != "done" else ""
        starved = self._starved() if state.outcome == "failed" else {}
        file = self._task.file
        lines = [f"{state.outcome}: {self._task.named}{time}{reason}", *([f"recorded in {file}"] if file else [])]
        self._view.result("\n".join(lines))
        return code, msgspec.to_builtins(state) | {"recorded_in": file} | starved

    def _unknown(self, why: str) -> Result:
        """The result when the executive cannot tell the task's outcome. A task ends with its executive."""
        outcome = "failed" if self._task.contact.dead(EXECUTIVE) else "unknown"
        starved = self._starved()
        self._view.result(f"{outcome}: {self._task.named}: {why}")
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
            return {by.name: by.pid for by in self._task.link.run_dir.claims().values()}
        return {}
