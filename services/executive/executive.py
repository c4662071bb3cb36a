"""Takes requests, runs one task at a time, and publishes its progress."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from copy import copy
from typing import Any

from cocoro import topics
from cocoro.clock import NS
from cocoro.entry_points import added_to
from cocoro.errors import choice_of
from cocoro.messages import (
    BaseState,
    CancelRequest,
    Health,
    KnownObject,
    ObjectsReply,
    ObjectsRequest,
    Outcome,
    Phase,
    RefusalCode,
    ReportRequest,
    TaskReply,
    TaskRequest,
    TasksReply,
    TasksRequest,
    TaskState,
)
from cocoro.messages.actions import TASK_GROUP, Action
from cocoro.node import Node
from cocoro.objects import Catalogue
from cocoro.task_table import described
from cocoro.tasks import Task, TaskFailedError
from services.executive.askers import Askers
from services.executive.by_hand import ByHand
from services.executive.config import ExecutiveConfig
from services.executive.estop import Estop
from services.executive.recovery import Recovery
from services.executive.skills import PlannerSkills
from services.executive.tasks import TASKS

Ending = tuple[Outcome, str | Awaitable[str]]
"""A task's outcome and its reason, which may still have to be found out."""
GONE = "the command or program that asked for it has ended, or is not heard any more"
REMEMBERED = 64
"""Number of ended tasks that the executive remembers."""
TOGETHER_S = 0.3
"""A link that is cut ends all contacts beyond it within this time."""
BACK_S = 3.0
"""Time after the return of the services in which an asker who was cut off with them must be back."""
_CLOCK_STANDS_S = 1.0
"""A clock that takes longer than this for 20 ms stands still."""


class Executive:
    def __init__(self, node: Node, config: ExecutiveConfig, catalogue: Catalogue) -> None:
        self._node = node
        self._config = config
        self._catalogue = catalogue
        self._alive: set[str] = set()
        self._unreadable: dict[str, str] = {}
        """By service: the input that it cannot read, and the reason."""
        self._running: asyncio.Task[Any] | None = None
        self._ended: asyncio.Future[Ending] | None = None
        """Gets the running task's outcome when something outside of it ends it."""
        self._count = 0
        self.state = TaskState()
        self._asker = ""
        """Who asked for the running task and is watched; empty when nobody is."""
        self._over: deque[TaskState] = deque(maxlen=REMEMBERED)
        self._base = node.latest(topics.BASE_STATE)
        self._publisher = node.publisher(topics.TASK)
        self._skills = PlannerSkills(node, config, catalogue, self._enter_phase, self._on_step)
        self._recovery: Recovery | None = None
        """Of the running task."""
        self._askers = Askers(node, self._on_asker_gone)
        self._estop = Estop(node, config.latch_hz, self._on_latch)
        node.watch_alive(self._on_alive)
        node.on(topics.HEALTH, self._on_health, service="*")
        node.serve(topics.RUN, self._run)
        node.serve(topics.CANCEL, self._cancel)
        node.serve(topics.REPORT, self._report)
        node.serve(topics.OBJECTS, self._objects)
        node.serve(topics.TASKS, self._tasks)
        ByHand(node, self._skills, lambda: self.state.task_id if self._runs else "", self._what_became_of, self._waits)

    async def settle(self) -> None:
        """Wait until it is known whether the emergency stop is latched, so that a robot that is up takes a task. Does
        not wait long, because a part that reports it may be broken."""
        if not await self._estop.known(self._config.latch_wait_s):
            self._node.log.warning("%s", self._estop.refusal)

    async def publish_progress(self) -> None:
        """Publish the task's progress until the service is ended."""
        async for _ in self._node.every(self._config.progress_hz, "progress"):
            self._publish()

    # --- requests ---------------------------------------------------------------------------------

    async def _run(self, request: TaskRequest) -> TaskReply:
        try:
            task = TASKS.read(request.task)
        except ValueError as error:
            return TaskReply(accepted=False, refusal="bad_request", text=_with_faults(str(error)))
        # What follows the last look at the asker happens at once: when he leaves after it, he finds his task running.
        while True:
            if request.asker and not await self._askers.present(request.asker):
                return TaskReply(accepted=False, refusal="asker_gone", text=GONE)
            refusal = self._refusal(task, instead=request.instead)
            if refusal is not None:
                code, text = refusal
                return TaskReply(accepted=False, refusal=code, text=text)
            if self._running is None:
                break
            self._end("cancelled", f"instead: the operator took the robot for {task.name}")
            await asyncio.wait({self._running})
        self._count += 1
        now_ns = self._node.now_ns()
        task_id = f"{task.name}-{now_ns}-{self._count}"
        self.state = TaskState(task_id=task_id, task=task.name, label=task.target, phase="start", started_ns=now_ns)
        self._skills.begin_task(task_id, self.state.measures)
        self._recovery = Recovery(
            self._node, self._config, self._skills, self._alive, lambda reason: self._end("failed", reason)
        )
        self._asker = request.asker
        self._ended = asyncio.get_running_loop().create_future()
        timeout_s = request.timeout_s or task.limit_s(self._config)
        self._running = self._node.spawn(self._carry_out(task, timeout_s, self._ended))
        return TaskReply(accepted=True, task_id=task_id)

    def _refusal(self, task: Task, *, instead: bool) -> tuple[RefusalCode, str] | None:
        """The reason for which a task cannot start now, or `instead` of the running one: a code, and a sentence with
        advice; None when it can."""
        if task.needs_label:
            known = self._catalogue.get(task.target)
            grasping = task.needs_label == "graspable"
            targets = [item.label for item in self._catalogue.targets if item.graspable or not grasping]
            if known is None or known.marker:
                return "unknown_label", f"unknown object {task.target!r}; {choice_of(task.target, targets)}"
            if grasping and not known.graspable:
                return "not_graspable", f"{task.target} does not fit into the hand; what does: {', '.join(targets)}"
        if lack := self._node.robot.lacks(task.needs_body):
            return "not_able", f"{lack}; {task.name} needs one"
        if self._running is not None and not instead:
            return "busy", f"{self._what()} is running; cancel it first (cocoro cancel)"
        if stopped := self._estop.refusal:
            return "estop", stopped
        missing = [service for service in (*self._config.needed, *task.services) if service not in self._alive]
        if missing:
            return "not_alive", f"{self._what_of(missing)}; see cocoro status"
        if self._unreadable:
            return "not_alive", f"{next(iter(self._unreadable.values()))}; see cocoro status"
        if self._node.clock.stands:  # then messages of any age seem fresh
            return "not_alive", "the clock stands still; see cocoro status"
        battery = self._base.value.battery_fraction if self._base.value is not None else 1.0
        if battery < self._config.battery_low and task.needs_battery:
            return "battery", f"the battery is low ({battery:.0%}); charge the robot first"
        status = self._skills.status
        if status is None:
            return "not_alive", "the planner says nothing; see cocoro status"
        if status.body_m is None:
            return "not_alive", f"the planner does not know yet where the robot stands ({status.why})"
        if task.hand == "empty" and status.holding:
            return "holding", "the hand holds something; put it down first (cocoro put-down)"
        if task.hand == "holding" and not status.holding:
            return "not_holding", "the hand holds nothing"
        return None

    def _what_of(self, missing: list[str]) -> str:
        """Tell the missing services that have died from those that are only not heard, in words."""
        dead = [service for service in missing if self._node.contact.dead(service)]
        unheard = [service for service in missing if service not in dead]
        texts = ((f"not alive: {', '.join(dead)}", dead), (f"no contact with {', '.join(unheard)}", unheard))
        return "; ".join(text for text, services in texts if services)

    async def _cancel(self, request: CancelRequest) -> TaskReply:
        if self._running is None or request.task_id not in ("", self.state.task_id):
            return TaskReply(accepted=False, refusal="no_task", text="no such task is running")
        self._end("cancelled", "by the operator")
        return TaskReply(accepted=True, task_id=self.state.task_id)

    async def _report(self, request: ReportRequest) -> TaskState:
        known = (self.state, *self._over)
        return next((state for state in known if request.task_id in ("", state.task_id)), TaskState())

    async def _objects(self, request: ObjectsRequest) -> ObjectsReply:
        status = self._skills.status
        seen = {estimate.label: estimate for estimate in status.known} if status is not None else {}
        return ObjectsReply(
            objects=tuple(
                KnownObject(
                    label=known.label,
                    shape=known.shape,
                    size_m=known.size_m,
                    graspable=known.graspable,
                    seen=seen.get(known.label),
                )
                for known in self._catalogue.targets
            )
        )

    async def _tasks(self, _: TasksRequest) -> TasksReply:
        return TasksReply(tasks=tuple(map(described, TASKS.all().values())))

    # --- the running task -------------------------------------------------------------------------

    async def _carry_out(self, task: Task, timeout_s: float, ended: asyncio.Future[Ending]) -> None:
        """Run a task from its acceptance to its outcome. An end from outside sets `ended` and never cancels this
        coroutine, so that every task comes to its outcome."""
        work = asyncio.ensure_future(task.run(self._skills))
        timer = asyncio.ensure_future(self._node.sleep(timeout_s))
        outcome: Outcome
        reason: str | Awaitable[str]
        try:
            await asyncio.wait((ended, work, timer), return_when=asyncio.FIRST_COMPLETED)
            if ended.done():
                outcome, reason = ended.result()
            elif work.done():
                outcome, reason = self._outcome_of(work)
            elif timer.result():
                outcome, reason = "failed", f"timed_out: the task took over {timeout_s:g} s"
            else:
                died = self._recovery.died if self._recovery is not None else ""
                outcome, reason = "failed", died or "clock: the clock began anew"
            if not ended.done():
                ended.set_result((outcome, reason))
        finally:
            work.cancel()
            timer.cancel()
            if self._recovery is not None:
                self._recovery.close()
            self._skills.stop(self.state.task_id)
        await self._come_to_rest()
        self._finish(outcome, reason if isinstance(reason, str) else await reason)

    def _outcome_of(self, work: asyncio.Future[str | None]) -> tuple[Outcome, str]:
        """Outcome and reason of a routine that has ended."""
        error = work.exception()
        if error is None:
            return "done", work.result() or ""
        if isinstance(error, TaskFailedError):
            return "failed", str(error)
        self._node.log.error("task %s failed", self.state.task_id, exc_info=error)
        return "failed", f"internal error: {error}"

    async def _come_to_rest(self) -> None:
        """Wait until the base stands, so that 'done' and 'failed' mean that the robot is still."""
        end_ns = self._node.now_ns() + round(self._config.settle_s * NS)
        while self._node.now_ns() < end_ns and not self._standing(self._base.fresh()):
            if "base" not in self._alive:
                return
            try:
                async with asyncio.timeout(_CLOCK_STANDS_S):
                    if not await self._node.sleep(0.02):
                        return
            except TimeoutError:  # the simulator has died: its clock stands still, and so do the wheels
                return

    @staticmethod
    def _standing(base: BaseState | None) -> bool:
        return base is not None and base.standing

    def _finish(self, outcome: Outcome, reason: str) -> None:
        self._close_phase()
        self._running = None
        self.state.elapsed_s = self._elapsed_s()
        self.state.outcome = outcome
        self.state.reason = reason
        self.state.phase = "end"
        self.state.text = reason or outcome
        self._node.log.info("%s %s %s", self._what(), outcome, reason)
        self._publish()
        self._over.append(copy(self.state))

    def _end(self, outcome: Outcome, reason: str | Callable[[], Awaitable[str]]) -> None:
        """End the running task from outside. `reason` may be a function that begins to find out the reason."""
        if self._runs and self._ended is not None:
            self._ended.set_result((outcome, reason if isinstance(reason, str) else reason()))

    def _what(self) -> str:
        return " ".join(filter(None, (self.state.task, self.state.label)))

    # --- what happens around it -------------------------------------------------------------------

    def _on_alive(self, service: str, alive: bool) -> None:
        if alive:
            self._alive.add(service)
            return
        self._alive.discard(service)
        self._unreadable.pop(service, None)
        if service in self._config.needed and self._recovery is not None and self._runs:
            self._recovery.lost(service)

    @property
    def _runs(self) -> bool:
        """Whether a task runs and nothing has ended it yet."""
        return self._running is not None and self._ended is not None and not self._ended.done()

    def _waits(self) -> str:
        """Why the running task waits for a service; '' when it does not."""
        return self._recovery.text if self._recovery is not None and self._runs else ""

    def _what_became_of(self, task_id: str) -> str:
        """What became of a task that does not run, for who goes on driving in it."""
        state = next((state for state in (self.state, *self._over) if task_id and state.task_id == task_id), None)
        if state is None:
            return "no such task runs"
        if state.outcome is None:
            return f"{state.task} is ending"
        return f"{state.task} has ended: {state.outcome}{f': {state.reason}' if state.reason else ''}"

    def _on_step(self, action: Action) -> None:
        if self._recovery is not None:
            self._recovery.step_begins(action)

    def _on_asker_gone(self, asker: str) -> None:
        if asker != self._asker or not self._runs or self._recovery is None:
            return
        if all(self._node.contact.lives(service) for service in self._config.needed):
            self._end("cancelled", f"asker_gone: {GONE}")
        else:  # a link to another machine may be cut, and the asker beyond it
            self._node.spawn(self._cancel_without(asker, self._recovery))

    async def _cancel_without(self, asker: str, recovery: Recovery) -> None:
        """Cancel the task of an asker who has gone, unless he was cut off together with services and is back soon after
        them. The robot stands meanwhile."""
        with recovery.away():
            here = await recovery.cut_off(TOGETHER_S) and await self._askers.present(asker, BACK_S)
        if not here and recovery is self._recovery:
            self._end("cancelled", f"asker_gone: {GONE}")

    def _on_health(self, health: Health) -> None:
        """End the task when a needed service can no longer read its input: it is as good as dead, and reports why."""
        if health.service not in (*self._config.needed, self._node.name):
            return
        fault = next((topic.fault for topic in health.topics if topic.unreadable), None)
        if fault is None:
            self._unreadable.pop(health.service, None)
            return
        self._unreadable[health.service] = f"{health.service} cannot read {fault}"
        self._end("failed", f"unreadable: {self._unreadable[health.service]}")

    def _on_latch(self, latched: bool, by: str) -> None:
        if latched:
            self._end("failed", f"estop: emergency stop by {by or 'unknown'}")

    # --- progress ---------------------------------------------------------------------------------

    def _enter_phase(self, name: str) -> None:
        if self.state.phases and self.state.phases[-1].name == name and self.state.phase == name:
            return  # it goes on after an interruption
        self._close_phase()
        self.state.phase = name
        self.state.phases = (*self.state.phases, Phase(name=name, start_ns=self._node.now_ns()))
        self._publish()

    def _close_phase(self) -> None:
        if self.state.phases and self.state.phases[-1].end_ns is None:
            last = self.state.phases[-1]
            ended = Phase(name=last.name, start_ns=last.start_ns, end_ns=self._node.now_ns())
            self.state.phases = (*self.state.phases[:-1], ended)

    def _elapsed_s(self) -> float:
        return max(self._node.now_ns() - self.state.started_ns, 0) / NS

    def _publish(self) -> None:
        status = self._skills.status
        state = self.state
        if self._running is not None:
            state.elapsed_s = self._elapsed_s()
            if status is not None:
                state.text, state.distance_m = status.why, status.distance_m
            state.text = self._waits() or self._skills.waits or state.text
        state.stamp_ns = self._node.now_ns()
        self._publisher.put(state)


def _with_faults(text: str) -> str:
    """Name the third parties' tasks that could not be loaded: one of them may be what was asked for."""
    return "; ".join((text, *added_to(TASK_GROUP).faults))
