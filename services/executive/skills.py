"""The steps that tasks are made of (`cocoro.tasks.Skills`), carried out by the planner on the mesh."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from cocoro import topics
from cocoro.clock import NS
from cocoro.messages import DriveReply, Intent, Motion, PlannerStatus
from cocoro.messages.actions import Action, Approach, Carry, Drive, GoThere, Idle
from cocoro.node import Node
from cocoro.objects import Catalogue
from cocoro.tasks import Limits, TaskFailedError
from cocoro.units import Vec2, Vec3
from services.executive.config import ExecutiveConfig
from services.executive.deadman import Deadman, Moment
from services.executive.tasks.steps import find

LOOSE_S = 0.5
"""A hand that feels nothing for longer has lost what it held. When the arm comes to rest the claws may feel nothing for
a moment, and then need a quarter of a second until they trust their grip again."""

LISTEN_S = 0.25
"""Time after which this process notes that it heard nothing of the planner. However long it really was, it counts as
this much: a process that did not run heard nothing, whoever spoke."""

LATELY_S = 1.0
"""Age of the newest sighting up to which an object need not be found again after an interruption."""
GRACE_S = 5.0
"""Time after an interruption in which a planner that lacks news of something may still get it."""


class _InterruptedError(Exception):
    """A step was interrupted, and the task may go on."""


class PlannerSkills:
    """Publishes intents and waits for the planner's answers. Calls `begins(action)` at the begin of each action, and
    `phase(name)` at that of each phase.

    Between `pause` and `go_on` the robot stands; then the interrupted action begins anew.
    """

    def __init__(
        self,
        node: Node,
        config: ExecutiveConfig,
        catalogue: Catalogue,
        phase: Callable[[str], None],
        begins: Callable[[Action], None] = lambda _: None,
    ) -> None:
        self._node = node
        self._config = config
        self._catalogue = catalogue
        self._phase = phase
        self._begins = begins
        self._plan = node.latest(topics.PLAN)
        self._base = node.latest(topics.BASE_STATE)
        self._publisher = node.publisher(topics.INTENT)
        self._step = 0
        self.paused = False
        """Whether the planner is to stand still now, whatever the task wants."""
        self._interrupted = False
        """Whether the present step has to begin anew."""
        self._resume: Callable[[Action], str] = lambda _: "again"
        self._why = ""
        """Of the last interruption: what it means to an action (`services.executive.recovery.Resume`), and the reason
        of a task that fails by it."""
        self._settled_since_ns: int | None = None
        self._went_on_s = -GRACE_S
        self._begun_by: int | None = None
        """The incarnation of the base, which defines the odometry frame, when the task asked for its place."""
        self.waits = ""
        """Why a task waits for the planner; empty when it does not."""
        self.intent = Intent(action=Idle())
        self.measures: dict[str, float] = {}
        """The running task's."""
        self._deadman = Deadman(1, self._now())
        """The running task's."""
        node.spawn(self._repeat(config.intent_hz))

    @property
    def limits(self) -> Limits:
        return self._config

    @property
    def status(self) -> PlannerStatus | None:
        return self._plan.fresh()

    def place(self) -> Vec2:
        status = self.status
        if status is None or status.body_m is None:
            raise TaskFailedError("not_alive", "the planner does not say where the robot stands")
        self._begun_by = self._frame
        return status.body_m

    @property
    def _frame(self) -> int | None:
        return self._base.value.incarnation if self._base.value is not None else None

    @property
    def action(self) -> Action:
        """What the task wants now."""
        action: Action = self.intent.action
        return action

    def size_m(self, label: str) -> Vec3:
        known = self._catalogue.get(label)
        if known is None:
            raise KeyError(label)
        return known.size_m

    def now_s(self) -> float:
        return self._node.now_ns() / NS

    def want(self, action: Action, task_id: str) -> None:
        """Publish a new intent now; it is repeated until the next."""
        self._step += 1
        self.intent = Intent(task_id=task_id, step=self._step, action=action)
        self._publish()

    def begin_task(self, task_id: str, measures: dict[str, float]) -> None:
        """Forget the task before, and have the planner stand still for this one."""
        self.measures = measures
        self._begun_by = None
        self._deadman = Deadman(self._deadman.next_tick, self._now())
        self.stop(task_id)

    def stop(self, task_id: str) -> None:
        """Have the planner stand still, for a task that begins or has ended."""
        self.paused = self._interrupted = False
        self.want(Idle(), task_id)

    def pause(self) -> None:
        """Have the planner stand still until `go_on`."""
        self.paused, self._settled_since_ns = True, None
        self._publish()

    def settled(self, seconds: float) -> bool:
        """Whether the planner, which is to stand still, has said for so long that it could move: it has a fresh state
        of the whole robot, which is not latched. Ask often."""
        status, now_ns = self.status, self._node.now_ns()
        if status is None or (status.behaviour, status.state) != (Idle.tag(), "done"):
            self._settled_since_ns = None
            return False
        if self._settled_since_ns is None or now_ns < self._settled_since_ns:
            self._settled_since_ns = now_ns
        return now_ns - self._settled_since_ns >= seconds * NS

    def go_on(self, resume: Callable[[Action], str], why: str) -> None:
        """End a pause. The step that was interrupted begins anew, as `resume` says of its action."""
        self._resume, self._why = resume, why
        self.paused, self._interrupted, self._went_on_s = False, True, self.now_s()
        self.want(Idle(), self.intent.task_id)  # until the step begins anew

    def _now(self) -> Moment:
        return Moment(asyncio.get_running_loop().time(), self._node.now_ns())

    def input(self, tick: int, motion: Motion, why_not: str) -> DriveReply:
        """Take an operator's motion, as `Deadman.take`, and have the planner know at once what counts now."""
        reply = self._deadman.take(tick, motion, self._now(), why_not)
        if reply.accepted:
            self._publish()
        return reply

    def since_input_s(self) -> float:
        return self._deadman.since_input_s(self._now())

    def _publish(self) -> None:
        wanted = self.intent
        intent = Intent(task_id=wanted.task_id, step=wanted.step, action=Idle() if self.paused else wanted.action)
        if isinstance(intent.action, Drive) and (driven := self._deadman.motion(self._now())) is not None:
            intent.motion, intent.motion_until_ns = driven
        self._publisher.put(intent)

    async def _repeat(self, rate_hz: float) -> None:
        async for _ in self._node.every(rate_hz, "intent"):
            self._publish()

    async def do(self, action: Action, *, timeout_s: float) -> PlannerStatus:
        while True:
            self._begin(action)
            try:
                ended = await self._watch(self.now_s() + timeout_s)
                break
            except _InterruptedError:
                await self._prepare(action)
        if ended is None:
            status = self.status
            why = status.why if status is not None else ""
            raise TaskFailedError("timed_out", f"{action.name} took over {timeout_s:g} s: {why}")
        return ended

    async def keep_doing(
        self, action: Action, *, until_s: float, watch: Callable[[PlannerStatus], None] = lambda status: None
    ) -> None:
        while True:
            self._begin(action)
            try:
                await self._watch(until_s, watch)
                return
            except _InterruptedError:
                await self._prepare(action)

    def measure(self, name: str, value: float) -> None:
        self.measures[name] = round(value, 3)

    def _begin(self, action: Action) -> None:
        if isinstance(action, (Carry, GoThere)) and self._frame != self._begun_by:
            raise TaskFailedError("not_alive", "base was restarted, so the place to go to is not known any more")
        self._phase(action.name)
        self._begins(action)
        self.want(action, self.intent.task_id)

    async def _prepare(self, action: Action) -> None:
        """Do what has to be done before an interrupted action begins anew."""
        resume, label = self._resume(action), action.target
        if resume == "holding" and (self.status is None or not self.status.holding):
            raise TaskFailedError(*self._why.split(": ", 1))
        if resume in ("find", "approach"):
            known = self.status.known if self.status is not None else ()
            if not any(item.label == label and item.age_s <= LATELY_S for item in known):
                await find(self, label)
        if resume == "approach":
            await self.do(Approach(label), timeout_s=self.limits.approach_timeout_s)

    async def _watch(
        self, until_s: float, watch: Callable[[PlannerStatus], None] = lambda status: None
    ) -> PlannerStatus | None:
        """Wait until the planner reports the wanted action as done; None when it is not by `until_s`. `watch` gets each
        status of the action. Raises TaskFailedError when it reports a failure."""
        while True:
            status = await self._next_status()
            if self._answers(status):
                watch(status)
                if status.state == "done":
                    return status
                if status.state == "failed":
                    if status.reason == "stale" and 0 <= self.now_s() - self._went_on_s < GRACE_S:
                        await self._node.sleep(LISTEN_S)
                        raise _InterruptedError
                    raise TaskFailedError(status.reason, status.why)
            if self.now_s() > until_s:
                return None

    def _answers(self, status: PlannerStatus) -> bool:
        """Whether a status is about the wanted action. A planner that has missed the intents for a while is idle."""
        wanted = self.intent
        return (status.task_id, status.step, status.behaviour) == (wanted.task_id, wanted.step, wanted.action.name)

    async def watch_hold(self, seconds: float) -> None:
        self._phase("hold")
        while True:
            try:
                await self._hold(seconds)
                return
            except _InterruptedError:  # the arm stays where it is, and the time begins anew
                pass

    async def _hold(self, seconds: float) -> None:
        end_ns = self._node.now_ns() + round(seconds * NS)
        loose_since_ns: int | None = None
        while True:
            status = await self._next_status()
            now_ns = self._node.now_ns()
            if status.holding:
                loose_since_ns = None
                if now_ns >= end_ns:
                    return
            elif loose_since_ns is None:
                loose_since_ns = now_ns
            elif now_ns - loose_since_ns > LOOSE_S * NS:
                raise TaskFailedError("slipped", "the hand has lost what it held")

    async def _next_status(self) -> PlannerStatus:
        """The next status. Waits for a planner that is late; raises TaskFailedError when it is late for too long.
        Passes over a pause, and raises _InterruptedError after it."""
        while True:
            status = await self._heard()
            if self._interrupted:
                self._interrupted = False
                raise _InterruptedError
            if not self.paused:
                return status

    async def _heard(self) -> PlannerStatus:
        """The next status, in a pause, too."""
        heard_nothing_s = 0.0
        waiting = asyncio.ensure_future(self._plan.next())
        try:
            while True:
                timer = asyncio.ensure_future(self._node.sleep(LISTEN_S))
                try:
                    await asyncio.wait((waiting, timer), return_when=asyncio.FIRST_COMPLETED)
                finally:
                    timer.cancel()
                if waiting.done():
                    return waiting.result()
                if self.paused:  # who paused it waits for the planner
                    heard_nothing_s, self.waits = 0.0, ""
                    continue
                heard_nothing_s += LISTEN_S
                if heard_nothing_s >= self._config.planner_silence_s:
                    raise TaskFailedError("not_alive", f"nothing from the planner for {heard_nothing_s:g} s")
                if heard_nothing_s >= self._config.planner_late_s:
                    self.waits = f"waiting: nothing from the planner for {heard_nothing_s:.1f} s"
        finally:
            self.waits = ""
            waiting.cancel()
