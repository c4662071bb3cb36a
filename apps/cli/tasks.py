"""Runs a task on a robot: requests it from the executive, follows it to its outcome, and reports that."""

from __future__ import annotations

import asyncio
import sys
from contextlib import suppress
from pathlib import Path

import msgspec

from apps.cli import exits
from apps.cli.interrupt import on_interrupt
from apps.cli.link import MeshLink, joined
from apps.cli.options import RobotChoice
from apps.cli.output import going_on, print_json
from apps.cli.progress import TaskDisplay, task_display
from apps.cli.snapshot import SnapshotTaker, check
from cocoro.errors import CallTimeoutError, CocoroError
from cocoro.messages import CancelRequest, TaskReply, TaskRequest, TaskState
from cocoro.tasks import Task
from cocoro.topics import CANCEL, LATCH, RUN, TASK
from deploy.contact import RECOVERY_S, ProcessContact, SleepDetector

USAGE_REFUSALS = ("unknown_label", "not_graspable", "bad_request")
"""Refusals that are the operator's mistake, not the robot's state."""
UNSETTLED = ("not_alive", "estop")
"""Refusals of an executive that has just started and has not yet received every service's state."""
SETTLE_S = 3.0
"""Longest time for which an unsettled refusal is answered by another request."""
ASK_AGAIN_S = 0.1
"""Time between two of these requests."""
CANCEL_S = 10.0
"""Longest wait for the outcome of a cancelled task."""
EXECUTIVE = "executive"
LOOK_S = 0.2
"""Time between two checks whether a silent executive has died."""


async def run(choice: RobotChoice, request: TaskRequest, as_json: bool, picture: Path | None) -> int:
    """Runs a task to its outcome and returns the exit code. `picture`: file for the last picture of the task's snapshot
    phase.

    Raises MeshError when the robot or its executive is not there, ConfigError for a name that is not a PNG file's.
    """
    if picture is not None:
        check(picture)
    async with joined(choice, frames=picture is not None) as link:
        contact = ProcessContact(link.run_dir.claimant_pid, SleepDetector())
        follower = Follower(link, request, task_display(as_json), picture, contact)
        with on_interrupt(follower.interrupt), going_on():
            code, result = await follower.run()
    if as_json:
        print_json(result)
    return code


async def cancel(choice: RobotChoice) -> int:
    """Cancels the running task; the exit code is 3 when none runs."""
    async with joined(choice) as link:
        reply = await link.call(CANCEL, CancelRequest())
    if not reply.accepted:
        print(f"cocoro: refused: {reply.text}", file=sys.stderr)
        return exits.REFUSED
    print(reply.text or "cancelled")
    return exits.DONE


class Follower:
    """Requests one task and follows it to its outcome."""

    def __init__(
        self,
        link: MeshLink,
        request: TaskRequest,
        view: TaskDisplay,
        picture: Path | None,
        contact: ProcessContact | None = None,
    ) -> None:
        """`contact` finds out what happened to an executive that is silent."""
        self._contact = contact or ProcessContact(link.run_dir.claimant_pid)
        self._link = link
        self._request = request
        self._task: Task = request.task
        self._view = view
        self._picture = picture
        self._name = f"{self._task.name} {self._task.target}".strip()
        self._task_id = ""
        self._news: asyncio.Queue[TaskState | bool] = asyncio.Queue()
        """States of the task, and whether the executive's liveliness token is present, at each change."""
        self._interrupted = asyncio.Event()

    def interrupt(self) -> None:
        """Handles Ctrl-C: the first cancels the task on the robot, the second ends the command."""
        if self._interrupted.is_set():
            raise KeyboardInterrupt
        self.cancel()

    def cancel(self) -> None:
        """Cancels the task on the robot; `run` then returns its outcome."""
        self._interrupted.set()

    async def run(self) -> tuple[int, dict[str, object]]:
        """Runs the task; returns the exit code and the result as data."""
        news = self._link.inbox(TASK)  # before the request, so that no state is missed
        news.add(lambda _key, state: self._news.put_nowait(state))
        alive = self._link.watch_alive(self._on_alive, EXECUTIVE)
        reply = await self._ask()
        if not reply.accepted:
            return self._refused(reply)
        self._task_id = reply.task_id
        beside = [asyncio.create_task(self._cancel_when_interrupted())]
        if self._contact.keeps:
            beside.append(asyncio.create_task(self._contact.keep()))
        try:
            state = await self._follow()
        finally:
            self._view.close()
            alive.close()
            for task in beside:
                task.cancel()
        return self._outcome(state)

    def _on_alive(self, _service: str, alive: bool) -> None:
        if alive:
            self._contact.met(EXECUTIVE)
        self._news.put_nowait(alive)

    async def _ask(self) -> TaskReply:
        """Requests the task, repeatedly for a short time when the robot has only just started."""
        latch = self._link.latest(LATCH)
        for _ in range(round(SETTLE_S / ASK_AGAIN_S)):
            reply = await self._link.call(RUN, self._request)
            latched = latch.value is not None and latch.value.state == "latched"
            if reply.accepted or reply.refusal not in UNSETTLED or (reply.refusal == "estop" and latched):
                break
            await asyncio.sleep(ASK_AGAIN_S)
        return reply

    async def _follow(self) -> TaskState:
        """The task's last state, from the executive, or composed here when the executive died or stays silent."""
        camera: SnapshotTaker | None = None
        while True:
            news = await self._news.get()
            state = await self._after_silence() if news is False else news
            if isinstance(state, bool) or state.task_id != self._task_id:
                continue
            if self._picture is not None:
                if state.phase == self._task.snapshot_phase and camera is None:
                    camera = SnapshotTaker(self._link)
                    camera.open()
                elif state.phase != self._task.snapshot_phase and camera is not None:
                    await self._take(camera, self._picture)
                    camera = None
            if state.outcome is not None:
                return state
            self._view.show(state)

    async def _after_silence(self) -> TaskState:
        """The task's next state after the executive's token was lost; a failed state when the executive died or stays
        silent."""
        lost = await self._contact.lost(EXECUTIVE)
        if not self._contact.dead(EXECUTIVE):
            self._view.say(f"{lost}: waiting for the executive")
        end_s = asyncio.get_running_loop().time() + RECOVERY_S
        while (left_s := end_s - asyncio.get_running_loop().time()) > 0:
            if self._contact.dead(EXECUTIVE):
                return self._failed(f"{EXECUTIVE} died")
            with suppress(TimeoutError):
                news = await asyncio.wait_for(self._news.get(), min(left_s, LOOK_S))
                if isinstance(news, bool):
                    continue
                if news.task_id == self._task_id:
                    return news
                # An executive that publishes another task now has restarted without this one.
                return self._failed("the executive restarted and no longer knows the task")
        return self._failed(f"{lost}; the task may still be running; see cocoro status")

    def _failed(self, reason: str) -> TaskState:
        """A failed state, composed when the executive cannot publish it."""
        return TaskState(
            task_id=self._task_id,
            task=self._task.name,
            label=self._task.target,
            outcome="failed",
            reason=reason,
        )

    async def _take(self, camera: SnapshotTaker, picture: Path) -> None:
        try:
            self._view.say(await camera.write(picture))
        except CocoroError as error:
            self._view.say(f"no picture: {error}")

    async def _cancel_when_interrupted(self) -> None:
        await self._interrupted.wait()
        self._view.say(f"cancelling {self._name} (Ctrl-C again ends without waiting)")
        try:
            reply = await self._link.call(CANCEL, CancelRequest(task_id=self._task_id))
            if reply.accepted:
                await asyncio.sleep(CANCEL_S)
                self._view.say("the task does not end; `cocoro estop` stops the robot")
            else:
                self._view.say(f"not cancelled: {reply.text}")
        except CallTimeoutError:
            self._view.say("the executive does not answer; `cocoro estop` stops the robot")
        except CocoroError as error:
            self._view.say(f"not cancelled: {error}")

    # --- the end ----------------------------------------------------------------------------------

    def _refused(self, reply: TaskReply) -> tuple[int, dict[str, object]]:
        result = {"task": self._task.name, "label": self._task.target, "outcome": "refused"}
        print(f"cocoro: refused: {reply.text}", file=sys.stderr)
        code = exits.USAGE if reply.refusal in USAGE_REFUSALS else exits.REFUSED
        return code, result | {"reason": reply.refusal, "text": reply.text}

    def _outcome(self, state: TaskState) -> tuple[int, dict[str, object]]:
        code = {"done": exits.DONE, "failed": exits.FAILED, "cancelled": exits.REFUSED}[state.outcome or "failed"]
        time = f" {'in' if state.outcome == 'done' else 'after'} {state.elapsed_s:.1f} s" if state.elapsed_s else ""
        reason = f": {state.reason}" if state.reason and state.outcome != "done" else ""
        self._view.result(f"{state.outcome}: {self._name}{time}{reason}")
        return code, msgspec.to_builtins(state)
