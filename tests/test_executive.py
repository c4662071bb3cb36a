"""The executive, with a planner and hardware that do as a test's script says."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from message_samples import data_of

from cocoro import topics
from cocoro.clock import NS, Clock
from cocoro.messages import (
    BaseState,
    CancelRequest,
    EstopReply,
    EstopRequest,
    Intent,
    LatchState,
    ObjectsRequest,
    PlannerStatus,
    ServoState,
    TargetEstimate,
    TaskReply,
    TaskRequest,
    TaskState,
)
from cocoro.testing import JumpingClock, ServiceUnderTest, in_virtual_time
from cocoro.topics import HARDWARE, STOPPABLE
from services.executive import executive

FETCH = ("search", "approach", "reach", "grasp", "lift")


class Robot:
    """An executive under test, and all that it needs around it."""

    def __init__(self, service: ServiceUnderTest) -> None:
        self.service = service
        self.script: dict[str, list[str]] = {}
        """By behaviour, how its next steps end: 'done', a reason to fail, or 'never'; done when nothing is said."""
        self.takes_s = 0.1
        self.holding = False
        self.speed_mps = 0.0
        self.silent = False
        self.says: dict[str, LatchState] = dict.fromkeys(STOPPABLE, "released")
        self.task_id = ""
        self.asked: list[str] = []
        """The behaviours that were wanted, each once."""
        self._intent = Intent()
        self._since_ns = 0
        self._end = "done"
        service.tester.on(topics.INTENT, self._hear)
        service.tester.spawn(self._work())

    def _hear(self, intent: Intent) -> None:
        if (intent.task_id, intent.step) == (self._intent.task_id, self._intent.step):
            return
        self._intent, self._since_ns = intent, self.service.tester.now_ns()
        self.asked.append(intent.behaviour)
        self._end = (self.script.get(intent.behaviour) or ["done"]).pop(0)

    async def _work(self) -> None:
        async for _ in self.service.tester.every(50.0):
            self._tell_hardware()
            if not self.silent:
                self.service.feed(topics.PLAN, self.status())

    def _tell_hardware(self) -> None:
        for name in STOPPABLE:
            if name == "base" and name in self.says:
                here = {"odometry_m": (0.0, 0.0), "odometry_yaw_rad": 0.0, "turn_rate_radps": 0.0}
                state = BaseState(**here, speed_mps=self.speed_mps, latch=self.says[name])  # type: ignore[arg-type]
                self.service.feed(topics.BASE_STATE, state)
            elif name in self.says:
                servos = ServoState(joints=(), position_rad=(), speed_radps=(), load=(), latch=self.says[name])
                self.service.feed(topics.ARM_STATE if name == "arm" else topics.HAND_STATE, servos)

    def status(self, **changes: Any) -> PlannerStatus:
        over = self.service.tester.now_ns() - self._since_ns >= self.takes_s * NS and self._end != "never"
        status = PlannerStatus(
            task_id=self._intent.task_id,
            step=self._intent.step,
            behaviour=self._intent.behaviour,
            state=("done" if self._end == "done" else "failed") if over else "running",
            reason=self._end if over and self._end != "done" else "",
            why=f"{self._intent.behaviour} is what I do",
            distance_m=0.5,
            holding=self.holding,
            body_m=(0.0, 0.0),
            known=(TargetEstimate(label="red_can", position_m=(1.0, 0.0, 0.06), age_s=3.0),),
        )
        return msgspec.structs.replace(status, **changes)

    # --- what an operator does ------------------------------------------------------------------------

    async def ask(self, task: str = "fetch", label: str = "red_can", **more: Any) -> TaskReply:
        return await self.service.ask(topics.RUN, TaskRequest(task=task, label=label, **more))  # type: ignore[arg-type]

    async def begin(self, task: str = "fetch", label: str = "red_can", **more: Any) -> str:
        reply = await self.ask(task, label, **more)
        assert reply.accepted, reply.text
        self.task_id = reply.task_id
        return reply.task_id

    async def estop(self, latched: bool) -> EstopReply:
        """Ask the executive alone."""
        return await self.service.ask(topics.ESTOP.of("executive"), EstopRequest(latched=latched, by="test"))

    def state(self) -> TaskState:
        """What was said last of a task; nothing of any when nothing was said."""
        return (self.service.outputs(topics.TASK) or [TaskState()])[-1]

    async def outcome(self) -> TaskState:
        """Of the task that was begun last."""

        def over() -> bool:
            state = self.state()
            return state.outcome is not None and state.task_id == self.task_id

        await self.service.until(over, timeout_s=300.0)
        return self.state()

    async def phase(self, name: str) -> None:
        await self.service.until(lambda: self.state().phase == name)

    def latch(self) -> LatchState:
        return self.service.latest(topics.LATCH).state


@asynccontextmanager
async def robot(clock: Clock | None = None, ready: bool = True, **config: Any) -> AsyncIterator[Robot]:
    """A robot whose services all live and whose hardware is released, or (`ready=False`) nothing yet."""
    async with ServiceUnderTest("services.executive.service", config, clock=clock) as service:
        robot = Robot(service)
        if ready:
            service.others_live(*HARDWARE, "perception", "planning")
            await service.advance(0.5)
        yield robot


def idle_again(robot: Robot) -> bool:
    return robot.service.latest(topics.INTENT).behaviour == "idle"


# --- a fetch --------------------------------------------------------------------------------------


@in_virtual_time
async def test_a_fetch_is_a_search_a_drive_a_reach_a_grasp_and_a_lift_that_stays_held() -> None:
    async with robot() as it:
        task_id = await it.begin()
        await it.phase("hold")
        it.holding = True
        it.service.forget()
        state = await it.outcome()
        assert tuple(name for name in it.asked if name != "idle") == FETCH
        assert (state.task_id, state.task, state.label) == (task_id, "fetch", "red_can")
        assert (state.outcome, state.reason, state.phase) == ("done", "", "end")
        assert tuple(phase.name for phase in state.phases) == (*FETCH, "hold")
        assert idle_again(it)


@in_virtual_time
async def test_phases_follow_each_other_without_a_gap_and_the_time_counts_to_the_end() -> None:
    async with robot() as it:
        it.holding = False
        await it.begin("park", "")
        state = await it.outcome()
        assert state.phases[-1].end_ns is not None
        assert state.elapsed_s == pytest.approx((state.phases[-1].end_ns - state.started_ns) / NS, abs=0.03)

        it.script = {"search": ["never"]}
        await it.begin(timeout_s=10.0)
        await it.service.advance(5.0)
        for before, after in zip(it.state().phases, it.state().phases[1:], strict=False):
            assert before.end_ns == after.start_ns


@in_virtual_time
async def test_progress_is_told_in_the_planners_words_and_the_intent_is_repeated() -> None:
    async with robot() as it:
        it.script = {"approach": ["never"]}
        await it.begin()
        await it.phase("approach")
        it.service.forget()
        await it.service.advance(2.0)
        states = it.service.outputs(topics.TASK)
        assert len(states) == pytest.approx(2.0 * 5.0, abs=1)
        assert {(state.text, state.distance_m) for state in states} == {("approach is what I do", 0.5)}
        assert [state.elapsed_s for state in states] == sorted({state.elapsed_s for state in states})
        intents = it.service.outputs(topics.INTENT)
        assert len(intents) == pytest.approx(2.0 * 50.0, abs=1)
        assert len({intent.step for intent in intents}) == 1


@pytest.mark.parametrize(
    ("script", "outcome", "reason"),
    [
        ({"grasp": ["no_grip"]}, "done", ""),
        ({"lift": ["slipped"]}, "done", ""),
        ({"lift": ["slipped", "slipped"]}, "failed", "slipped"),
        ({"grasp": ["no_grip"], "lift": ["slipped"]}, "failed", "slipped"),
        ({"approach": ["lost"], "reach": ["unreachable"]}, "done", ""),
        ({"approach": ["lost"] * 9}, "failed", "lost"),
        ({"reach": ["blocked"]}, "failed", "blocked"),
        ({"approach": ["stale"]}, "failed", "stale"),
        ({"search": ["not_found"] * 9}, "failed", "not_found"),
        ({"search": ["never"]}, "failed", "timed_out"),
    ],
)
def test_what_is_tried_again_and_what_is_not(script: dict[str, list[str]], outcome: str, reason: str) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot(hold_s=0.5, search_timeout_s=5.0) as it:
            it.script = script
            await it.begin()
            it.holding = True
            state = await it.outcome()
            assert (state.outcome, state.reason.partition(":")[0]) == (outcome, reason)
            assert idle_again(it)

    scenario()


@in_virtual_time
async def test_what_slips_while_it_is_held_up_is_noticed() -> None:
    async with robot() as it:
        await it.begin()
        it.holding = True
        await it.phase("hold")
        it.holding = False
        await it.phase("search")
        it.holding = True
        await it.phase("hold")
        it.holding = False
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("failed", "slipped: the hand has lost what it held")


@in_virtual_time
async def test_a_planner_that_was_idle_because_it_heard_nothing_has_done_no_step() -> None:
    async with robot() as it:
        it.script = {"approach": ["never"]}
        await it.begin()
        await it.phase("approach")
        it.silent = True
        for _ in range(20):
            it.service.feed(topics.PLAN, it.status(behaviour="idle", state="done", why="the executive is silent"))
            await it.service.advance(0.02)
        it.silent = False
        await it.service.advance(0.5)
        assert it.state().phase == "approach"


# --- ends from outside ----------------------------------------------------------------------------


@in_virtual_time
async def test_a_cancelled_task_says_so_when_the_robot_stands() -> None:
    async with robot() as it:
        it.script, it.speed_mps = {"approach": ["never"]}, 0.3
        task_id = await it.begin()
        await it.phase("approach")
        assert (await it.service.ask(topics.CANCEL, CancelRequest(task_id=task_id))).accepted
        await it.service.advance(1.0)
        assert idle_again(it)
        assert it.state().outcome is None, "it still rolls"
        it.speed_mps = 0.0
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("cancelled", "by the operator")


@in_virtual_time
async def test_only_the_task_that_runs_can_be_cancelled() -> None:
    async with robot() as it:
        assert (await it.service.ask(topics.CANCEL, CancelRequest())).refusal == "no_task"
        it.script = {"search": ["never"]}
        await it.begin()
        assert (await it.service.ask(topics.CANCEL, CancelRequest(task_id="another"))).refusal == "no_task"
        assert (await it.service.ask(topics.CANCEL, CancelRequest())).accepted


@pytest.mark.parametrize("ended_by", ["cancel", "estop", "death"])
@pytest.mark.parametrize("when", [*range(1, 9), "in the middle", "coming to rest"])
def test_whatever_ends_a_task_and_whenever_it_ends_once_and_another_can_follow(ended_by: str, when: int | str) -> None:
    """A number is how many turns of the loop after the request."""

    @in_virtual_time
    async def scenario() -> None:
        async with robot() as it:
            it.script = {"search": ["lost"] * 9 if when == "coming to rest" else ["never"]}
            it.speed_mps = 0.3
            run = asyncio.ensure_future(it.ask())
            if isinstance(when, str):
                await it.service.advance(1.0)
            else:
                for _ in range(when):
                    await asyncio.sleep(0)
            if ended_by == "cancel":
                await it.service.ask(topics.CANCEL, CancelRequest())
            elif ended_by == "estop":
                await it.estop(latched=True)
            else:
                it.service.other_dies("base")
            accepted = (await run).accepted
            await it.service.advance(10.0)
            states = [state for state in it.service.outputs(topics.TASK) if state.outcome is not None]
            assert len({(state.outcome, state.reason) for state in states}) <= 1
            if isinstance(when, str):
                assert accepted
                assert states[-1].outcome == (
                    "cancelled" if ended_by == "cancel" and when != "coming to rest" else "failed"
                )

            it.service.forget()
            it.script, it.speed_mps, it.holding = {}, 0.0, False
            it.service.others_live("base")
            await it.estop(latched=False)
            await it.service.advance(0.5)
            await it.begin("park", "")
            await it.service.until(lambda: it.state().task == "park" and it.state().outcome == "done")

    scenario()


@pytest.mark.parametrize("service", [*HARDWARE, "perception", "planning"])
def test_a_task_fails_when_a_service_that_it_needs_dies(service: str) -> None:
    @in_virtual_time
    async def scenario() -> None:
        async with robot() as it:
            it.script = {"search": ["never"]}
            await it.begin()
            await it.phase("search")
            it.service.other_dies(service)
            state = await it.outcome()
            assert (state.outcome, state.reason) == ("failed", f"not_alive: {service} died")
            refused = await it.ask()
            assert (refused.refusal, refused.text) == ("not_alive", f"not alive: {service}; see cocoro status")

    scenario()


@in_virtual_time
async def test_a_planner_that_lives_but_says_nothing_fails_the_task() -> None:
    async with robot() as it:
        it.script = {"search": ["never"]}
        await it.begin()
        await it.phase("search")
        it.silent = True
        silent_s = it.service.tester.now_ns() / NS
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("failed", "not_alive: the planner is silent")
        assert state.stamp_ns / NS - silent_s < 4.0
        assert (await it.ask()).refusal == "not_alive"


@in_virtual_time
async def test_a_mistake_in_a_task_is_told_and_is_not_the_end_of_the_executive(monkeypatch: pytest.MonkeyPatch) -> None:
    async def broken(*_: object) -> None:
        raise ZeroDivisionError("a mistake")

    monkeypatch.setitem(executive.TASKS, "park", broken)
    async with robot() as it:
        await it.begin("park", "")
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("failed", "internal error: a mistake")
        it.service.forget()
        await it.begin("fetch", "red_can", timeout_s=1.0)
        assert (await it.outcome()).reason.startswith("timed_out")


@in_virtual_time
async def test_when_the_clock_begins_anew_the_task_ends_and_the_next_one_can_begin() -> None:
    clock = JumpingClock()
    clock.jump_to(1000.0)
    async with robot(clock) as it:
        it.script = {"search": ["never"]}
        await it.begin()
        await it.phase("search")
        clock.jump_to(1.0)
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("failed", "clock: the clock began anew")
        assert state.elapsed_s >= 0.0
        it.service.forget()
        await it.service.advance(0.5)
        await it.begin("park", "")
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("done", "")


# --- refusals -------------------------------------------------------------------------------------


@in_virtual_time
async def test_nothing_begins_while_the_clock_stands_however_fresh_all_seems() -> None:
    clock = JumpingClock()
    async with robot(clock) as it:
        clock.stands = True
        refused = await it.ask()
        assert (refused.refusal, refused.text) == ("not_alive", "the clock stands still; see cocoro status")
        clock.stands = False
        assert (await it.ask()).accepted


@in_virtual_time
async def test_a_task_that_cannot_be_is_refused_with_what_to_do() -> None:
    async with robot() as it:
        unknown = await it.ask(label="teapot")
        assert unknown.refusal == "unknown_label"
        assert unknown.text.startswith("unknown object 'teapot'; known are red_can, green_can, blue_can")
        assert (await it.ask(label="magenta_marker")).refusal == "unknown_label"
        assert (await it.ask("put-down", "")).refusal == "not_holding"
        it.holding = True
        await it.service.advance(0.1)
        assert (await it.ask()).refusal == "holding"
        assert (await it.ask("park", "")).refusal == "holding"
        it.script = {"place": ["never"]}
        await it.begin("put-down", "")
        assert (await it.ask()).text == "put-down is running; cancel it first (cocoro cancel)"


@in_virtual_time
async def test_until_everyone_lives_no_task_begins() -> None:
    async with robot(ready=False) as it:
        await it.service.advance(1.0)
        assert (await it.ask()).refusal == "not_alive"
        it.service.others_live(*HARDWARE, "perception")
        await it.service.settle()
        assert (await it.ask()).text == "not alive: planning; see cocoro status"
        it.service.others_live("planning")
        await it.service.settle()
        assert (await it.ask()).accepted


# --- the emergency stop's word --------------------------------------------------------------------


@in_virtual_time
async def test_it_knows_no_latch_until_it_has_heard_of_one() -> None:
    async with ServiceUnderTest("services.executive.service") as service:
        await service.advance(30.0)
        assert {latch.state for latch in service.outputs(topics.LATCH)} == {"unknown"}


@in_virtual_time
async def test_when_nobody_knows_the_latch_nobody_ever_latched_it() -> None:
    async with robot(ready=False) as it:
        it.says = dict.fromkeys(STOPPABLE, "unknown")
        await it.service.advance(0.4)
        assert it.latch() == "unknown"
        await it.service.advance(0.4)
        assert it.latch() == "released"


@in_virtual_time
async def test_while_one_has_not_been_heard_the_others_not_knowing_says_nothing() -> None:
    async with robot(ready=False) as it:
        it.says = {"base": "unknown", "arm": "unknown"}
        await it.service.advance(10.0)
        assert it.latch() == "unknown"


@in_virtual_time
async def test_a_restarted_executive_believes_whoever_is_latched() -> None:
    async with robot(ready=False) as it:
        it.says = {"base": "unknown", "arm": "latched", "hand": "unknown"}
        await it.service.advance(0.2)
        assert it.latch() == "latched"


@in_virtual_time
async def test_a_restarted_executive_goes_on_where_the_hardware_does() -> None:
    async with robot(ready=False) as it:
        it.says = {"base": "released"}
        await it.service.advance(0.2)
        assert it.latch() == "released"


@in_virtual_time
async def test_latched_hardware_latches_everything_and_a_reset_is_not_undone_by_what_was_said_before_it() -> None:
    async with robot() as it:
        it.says["base"] = "latched"
        await it.service.advance(0.1)
        assert it.latch() == "latched"
        assert (await it.ask()).refusal == "estop"
        assert (await it.estop(latched=False)).latch == "released"
        await it.service.advance(0.3)
        assert it.latch() == "released"
        await it.service.advance(0.3)
        assert it.latch() == "latched", "the base is latched to this moment"


@in_virtual_time
async def test_a_latched_stop_ends_the_task_at_once_and_is_told_at_once() -> None:
    async with robot() as it:
        it.script = {"search": ["never"]}
        await it.begin()
        await it.phase("search")
        it.service.forget()
        await it.estop(latched=True)
        await it.service.settle()
        assert it.latch() == "latched"
        assert idle_again(it)
        assert (await it.outcome()).reason == "estop: emergency stop by test"


# --- what it knows --------------------------------------------------------------------------------


@in_virtual_time
async def test_known_objects_are_listed_with_where_they_were_seen() -> None:
    async with robot() as it:
        reply = await it.service.ask(topics.OBJECTS, ObjectsRequest())
        known = {item.label: item for item in reply.objects}
        assert {"red_can", "green_can", "blue_can"} <= set(known)
        assert "magenta_marker" not in known
        assert known["red_can"].seen is not None
        assert known["red_can"].seen.age_s == 3.0
        assert known["green_can"].seen is None
        assert known["red_can"].graspable


# --- abuse ----------------------------------------------------------------------------------------

READ = (topics.PLAN, topics.BASE_STATE, topics.ARM_STATE, topics.HAND_STATE)


@settings(max_examples=25, phases=[Phase.explicit, Phase.generate])
@given(data=st.data())
def test_nothing_that_is_published_brings_it_down(data: st.DataObject) -> None:
    def payload(topic: Any) -> Callable[[dict[str, Any]], tuple[Any, bytes]]:
        return lambda sent: (topic, msgpack.packb(sent))

    published = data.draw(
        st.lists(
            st.one_of(
                *(data_of(topic.type).map(payload(topic)) for topic in READ),
                *(st.binary(max_size=20).map(lambda raw, topic=topic: (topic, raw)) for topic in READ),  # type: ignore[misc]
            ),
            min_size=1,
            max_size=8,
        )
    )

    @in_virtual_time
    async def scenario() -> None:
        async with robot() as it:
            it.script = {"search": ["never"]}
            await it.ask()
            for topic, raw in published:
                it.service.feed_raw(topic, raw)
                await it.service.advance(0.02)
            await it.service.advance(0.5)
            assert it.service.running
            assert it.service.node.state == "ready"
            assert it.service.latest(topics.TASK).task in ("fetch", "")

    scenario()
