"""The executive's tasks: what they are made of, what is tried again, what is refused, and what it knows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgpack
import pytest
from executive_rig import idle_again, robot
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from message_samples import data_of

from cocoro import topics
from cocoro.clock import NS
from cocoro.messages import ObjectsRequest
from cocoro.testing import JumpingClock, in_virtual_time
from deploy.processes import hardware

FETCH = ("search", "approach", "reach", "grasp", "lift")


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
        ({"search": ["not_found"] * 9}, "done", ""),
        ({"search": ["not_found"] * 3, "explore": ["done", "done", "not_found"]}, "failed", "not_found"),
        ({"search": ["never"]}, "failed", "not_found"),
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
async def test_claws_that_feel_nothing_for_a_moment_have_lost_nothing() -> None:
    async with robot() as it:
        await it.begin()
        it.holding = True
        for _ in range(3):
            await it.phase("hold")
            it.holding = False
            await it.service.advance(0.4)
            it.holding = True
            await it.service.advance(0.1)
        state = await it.outcome()
        assert (state.outcome, state.reason) == ("done", "")
        assert "search" not in [phase.name for phase in state.phases[1:]]


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
        refused = await it.ask()
        assert not refused.accepted
        assert "put-down" in refused.text
        assert "cocoro cancel" in refused.text


@in_virtual_time
async def test_until_everyone_lives_no_task_begins() -> None:
    async with robot(ready=False) as it:
        await it.service.advance(1.0)
        assert (await it.ask()).refusal == "not_alive"
        it.service.others_live(*hardware(), "perception")
        await it.service.settle()
        assert (await it.ask()).text == "no contact with planning; see cocoro status"
        it.service.others_live("planning")
        await it.service.settle()
        assert (await it.ask()).accepted


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
