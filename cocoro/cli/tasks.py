"""`fetch`, `park`, `put-down` and `cancel`: ask the executive, follow the task to its outcome, say it."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import msgspec

from cocoro.cli import exits
from cocoro.cli.ending import on_end
from cocoro.cli.link import Link, Where, joined
from cocoro.cli.output import going_on
from cocoro.cli.progress import View, view
from cocoro.cli.snapshot import Snapshot, check
from cocoro.errors import CallTimeoutError, CocoroError
from cocoro.messages import CancelRequest, TaskReply, TaskRequest, TaskState
from cocoro.topics import CANCEL, LATCH, RUN, TASK

USAGE_REFUSALS = ("unknown_label", "not_graspable", "bad_request")
"""Refusals that are the operator's mistake, not the robot's state."""
UNSETTLED = ("not_alive", "estop")
"""Refusals that may be over in a moment: not everyone has been heard yet, or the emergency stop is not known yet."""
SETTLE_S = 3.0
ASK_AGAIN_S = 0.1
SNAPSHOT_PHASE = "grasp"
"""The picture is the last one of this phase: the claws have closed, the hand has not moved yet."""
CANCEL_S = 10.0
"""How long a cancelled task may take to say its outcome."""


async def run(where: Where, request: TaskRequest, as_json: bool, picture: Path | None) -> int:
    """Run a task to its outcome and return the exit code. `picture`: where to write what is seen at the grasp."""
    if picture is not None:
        check(picture)
    async with joined(where, frames=picture is not None) as link:
        follower = Follower(link, request, view(as_json), picture)
        with on_end(follower.interrupt), going_on():
            code, result = await follower.run()
    if as_json:
        print(json.dumps(result))
    return code


async def cancel(where: Where) -> int:
    async with joined(where) as link:
        reply = await link.call(CANCEL, CancelRequest())
    if not reply.accepted:
        print(f"cocoro: refused: {reply.text}", file=sys.stderr)
        return exits.REFUSED
    print(reply.text or "cancelled")
    return exits.DONE


class Follower:
    """One task, from the request to the outcome. `interrupt` cancels it on the robot."""

    def __init__(self, link: Link, request: TaskRequest, view: View, picture: Path | None) -> None:
        self._link = link
        self._request = request
        self._view = view
        self._picture = picture
        self._name = f"{request.task} {request.label}".strip()
        self._task_id = ""
        self._news: asyncio.Queue[TaskState | None] = asyncio.Queue()
        """What the executive says; None when it has died."""
        self._interrupted = asyncio.Event()

    def interrupt(self) -> None:
        """The first one cancels the task on the robot, the second one leaves at once."""
        if self._interrupted.is_set():
            raise KeyboardInterrupt
        self.cancel()

    def cancel(self) -> None:
        """Have the task cancelled on the robot, and wait for its outcome."""
        self._interrupted.set()

    async def run(self) -> tuple[int, dict[str, object]]:
        """The exit code, and the result as data."""
        news = self._link.inbox(TASK)  # before the call, so that nothing is missed
        news.add(lambda _key, state: self._news.put_nowait(state))
        alive = self._link.watch_alive("executive", lambda alive: None if alive else self._news.put_nowait(None))
        reply = await self._ask()
        if not reply.accepted:
            return self._refused(reply)
        self._task_id = reply.task_id
        cancelling = asyncio.create_task(self._cancel_when_interrupted())
        try:
            state = await self._follow()
        finally:
            alive.close()
            cancelling.cancel()
        return self._outcome(state)

    async def _ask(self) -> TaskReply:
        """Ask for the task; a robot that has only just come up gets a little time to find itself able."""
        latch = self._link.latest(LATCH)
        for _ in range(round(SETTLE_S / ASK_AGAIN_S)):
            reply = await self._link.call(RUN, self._request)
            latched = latch.value is not None and latch.value.state == "latched"
            if reply.accepted or reply.refusal not in UNSETTLED or (reply.refusal == "estop" and latched):
                break
            await asyncio.sleep(ASK_AGAIN_S)
        return reply

    async def _follow(self) -> TaskState | None:
        """The task's last state; None when the executive dies before."""
        camera: Snapshot | None = None
        while (state := await self._news.get()) is not None:
            if state.task_id != self._task_id:
                continue
            if self._picture is not None:
                if state.phase == SNAPSHOT_PHASE and camera is None:
                    camera = Snapshot(self._link)
                    camera.open()
                elif state.phase != SNAPSHOT_PHASE and camera is not None:
                    await self._take(camera, self._picture)
                    camera = None
            if state.outcome is not None:
                return state
            self._view.show(state)
        return None

    async def _take(self, camera: Snapshot, picture: Path) -> None:
        try:
            self._view.say(await camera.write(picture))
        except CocoroError as error:
            self._view.say(f"no picture: {error}")

    async def _cancel_when_interrupted(self) -> None:
        await self._interrupted.wait()
        self._view.say(f"cancelling {self._name} (once more leaves without waiting)")
        try:
            reply = await self._link.call(CANCEL, CancelRequest(task_id=self._task_id))
            if reply.accepted:
                await asyncio.sleep(CANCEL_S)
                self._view.say("the task does not end: `cocoro estop` stops the robot")
            else:
                self._view.say(f"not cancelled: {reply.text}")
        except CallTimeoutError:
            self._view.say("the executive does not answer: `cocoro estop` stops the robot")
        except CocoroError as error:
            self._view.say(f"not cancelled: {error}")

    # --- the end ----------------------------------------------------------------------------------

    def _refused(self, reply: TaskReply) -> tuple[int, dict[str, object]]:
        result = {"task": self._request.task, "label": self._request.label, "outcome": "refused"}
        print(f"cocoro: refused: {reply.text}", file=sys.stderr)
        code = exits.USAGE if reply.refusal in USAGE_REFUSALS else exits.REFUSED
        return code, result | {"reason": reply.refusal, "text": reply.text}

    def _outcome(self, state: TaskState | None) -> tuple[int, dict[str, object]]:
        if state is None:
            state = TaskState(
                task_id=self._task_id, task=self._request.task, label=self._request.label,
                outcome="failed", reason="executive died",
            )  # fmt: skip
        code = {"done": exits.DONE, "failed": exits.FAILED, "cancelled": exits.REFUSED}[state.outcome or "failed"]
        time = f" {'in' if state.outcome == 'done' else 'after'} {state.elapsed_s:.1f} s" if state.elapsed_s else ""
        reason = f": {state.reason}" if state.reason and state.outcome != "done" else ""
        self._view.result(f"{state.outcome}: {self._name}{time}{reason}")
        return code, msgspec.to_builtins(state)
