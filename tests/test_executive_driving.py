"""Driving by hand in the executive: whose motion counts and for how long, and what begins and ends it."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from executive_rig import Robot, idle_again, robot

from cocoro import topics
from cocoro.contact import Contact
from cocoro.driving import Driving
from cocoro.keys import asker_key
from cocoro.messages import DriveReply, DriveRequest, Motion
from cocoro.messages.driving import HOLD_S
from cocoro.testing import JumpingClock, in_virtual_time
from services.executive.tasks.drive import LEFT_ALONE_S

AHEAD = Motion(speed_mps=0.3)
BACK = Motion(speed_mps=-0.05)


@asynccontextmanager
async def driven(**more: Any) -> AsyncIterator[Robot]:
    """A robot whose task `drive` runs."""
    async with robot(**more) as it:
        it.script = {"drive": ["never"] * 9}
        await it.begin("drive", "")
        await it.phase("drive")
        yield it


async def give(it: Robot, tick: int, motion: Motion = AHEAD, task_id: str | None = None) -> DriveReply:
    """One request, as it arrives now."""
    question = DriveRequest(task_id=it.task_id if task_id is None else task_id, tick=tick, motion=motion)
    return await it.service.ask(topics.DRIVE, question)


def moves(it: Robot) -> Motion | None:
    """The motion in the newest intent."""
    return it.service.latest(topics.INTENT).motion


# --- the deadman ----------------------------------------------------------------------------------


@in_virtual_time
async def test_a_request_without_a_tick_gets_one_and_moves_nothing() -> None:
    async with driven() as it:
        reply = await give(it, 0)
        await it.service.advance(0.05)
        assert (reply.accepted, reply.refusal) == (False, "no_tick")
        assert moves(it) is None
        assert (await give(it, reply.tick)).accepted
        await it.service.settle()
        assert moves(it) == AHEAD


@in_virtual_time
async def test_a_motion_counts_until_the_hold_after_its_tick_was_issued_is_over() -> None:
    async with driven() as it:
        issued = await give(it, 0)
        issued_ns = it.service.tester.now_ns()
        await it.service.advance(0.15)
        assert (await give(it, issued.tick)).accepted
        await it.service.settle()
        intent = it.service.latest(topics.INTENT)
        assert intent.motion == AHEAD
        assert intent.motion_until_ns == issued_ns + round(HOLD_S * 1e9)
        await it.service.advance(HOLD_S - 0.15 + 0.021)  # one period of the intent later
        assert moves(it) is None


@in_virtual_time
async def test_an_input_that_comes_late_moves_nothing() -> None:
    async with driven() as it:
        tick = (await give(it, 0)).tick
        await it.service.advance(HOLD_S + 0.01)
        reply = await give(it, tick)
        await it.service.advance(0.05)
        assert reply.refusal == "no_tick"
        assert reply.tick > tick
        assert moves(it) is None


@in_virtual_time
async def test_a_request_that_is_sent_again_moves_nothing() -> None:
    async with driven() as it:
        tick = (await give(it, 0)).tick
        after = await give(it, tick)
        assert (await give(it, after.tick, Motion())).accepted
        replayed = await give(it, tick)
        await it.service.advance(0.05)
        assert replayed.refusal == "no_tick"
        assert moves(it) is None


@in_virtual_time
async def test_a_held_control_moves_the_robot_as_long_as_answers_come() -> None:
    async with driven() as it:
        tick = (await give(it, 0)).tick
        for _ in range(50):
            await it.service.advance(0.04)
            reply = await give(it, tick)
            tick = reply.tick
            assert reply.accepted
            await it.service.settle()
            assert moves(it) == AHEAD


@in_virtual_time
async def test_rest_needs_no_fresh_tick_and_is_told_the_planner_at_once() -> None:
    async with driven() as it:
        tick = (await give(it, 0)).tick
        old, tick = tick, (await give(it, tick)).tick
        assert (await give(it, old, Motion())).accepted
        await it.service.settle()
        assert moves(it) is None


@in_virtual_time
async def test_a_motion_of_the_last_task_moves_nothing_in_the_next() -> None:
    async with driven() as it:
        first, tick = it.task_id, (await give(it, 0)).tick
        await it.begin("drive", "", instead=True)
        await it.phase("drive")
        of_old = await give(it, tick, task_id=first)
        of_new = await give(it, tick)
        await it.service.advance(0.05)
        assert of_old.refusal == "no_task"
        assert "instead" in of_old.text
        assert of_new.refusal == "no_tick"
        assert moves(it) is None


@in_virtual_time
async def test_an_input_after_the_end_is_refused_with_the_reason_of_the_end() -> None:
    async with driven() as it:
        tick = (await give(it, 0)).tick
        await it.estop(latched=True)
        await it.outcome()
        reply = await give(it, tick)
        assert (reply.accepted, reply.refusal, reply.tick) == (False, "no_task", 0)
        assert "emergency stop" in reply.text
        assert (await give(it, 0, task_id="drive-unknown")).text == "no such task runs"


@in_virtual_time
async def test_a_clock_that_jumps_back_makes_every_tick_worthless() -> None:
    clock = JumpingClock()
    async with driven(clock=clock) as it:
        tick = (await give(it, 0)).tick
        tick = (await give(it, tick)).tick
        clock.jump_to(0.1)
        reply = await give(it, tick)
        assert not reply.accepted
        await it.service.advance(0.05)
        assert moves(it) is None


@in_virtual_time
async def test_a_robot_whose_clock_stands_forgets_a_motion_by_the_machines_time() -> None:
    class StandingClock(JumpingClock):
        """Stands when it is told to."""

        stood_ns: int | None = None

        def now_ns(self) -> int:
            return super().now_ns() if self.stood_ns is None else self.stood_ns

    clock = StandingClock()
    async with driven(clock=clock) as it:
        tick = (await give(it, 0)).tick
        tick = (await give(it, tick)).tick
        clock.stood_ns = clock.now_ns()
        await it.service.advance(0.3)
        assert (await give(it, tick)).refusal == "no_tick"


# --- two drivers ----------------------------------------------------------------------------------


@in_virtual_time
async def test_of_two_drivers_the_one_who_moves_the_robot_has_it_until_he_lets_go_for_a_second() -> None:
    async with driven() as it:
        one, other = (await give(it, 0)).tick, (await give(it, 0)).tick
        one = (await give(it, one)).tick
        refused = await give(it, other, BACK)
        await it.service.settle()
        assert refused.refusal == "other_driver"
        assert moves(it) == AHEAD
        rest = await give(it, refused.tick, Motion())  # the other one's rest is not the first one's
        await it.service.settle()
        assert moves(it) == AHEAD

        await give(it, one, Motion())
        await it.service.advance(0.9)
        refused = await give(it, (await give(it, rest.tick, Motion())).tick, BACK)
        assert refused.refusal == "other_driver"
        await it.service.advance(0.11)
        assert (await give(it, (await give(it, refused.tick, Motion())).tick, BACK)).accepted
        await it.service.settle()
        assert moves(it) == BACK


@in_virtual_time
async def test_a_driver_who_was_late_goes_on_though_another_waits() -> None:
    async with driven() as it:
        tick = (await give(it, 0)).tick
        tick = (await give(it, tick)).tick
        await give(it, 0, BACK)
        await it.service.advance(0.4)
        late = await give(it, tick)
        assert late.refusal == "no_tick"
        assert (await give(it, late.tick)).accepted


# --- begin and end --------------------------------------------------------------------------------


@in_virtual_time
async def test_a_running_task_is_busy_unless_another_is_asked_for_instead() -> None:
    async with robot() as it:
        it.script = {"search": ["never"] * 2, "drive": ["never"]}
        fetch = await it.begin()
        refused = await it.ask("drive", "")
        assert (refused.accepted, refused.refusal) == (False, "busy")
        assert it.state().task_id == fetch

        it.service.forget()
        drive = await it.begin("drive", "", instead=True)
        ended = next(state for state in it.service.outputs(topics.TASK) if state.outcome is not None)
        assert (ended.task_id, ended.outcome) == (fetch, "cancelled")
        assert ended.reason == "instead: the operator took the robot for drive"
        await it.phase("drive")
        assert it.state().task_id == drive


@in_virtual_time
async def test_the_task_instead_begins_when_the_robot_is_at_rest() -> None:
    async with robot() as it:
        it.script = {"search": ["never"], "drive": ["never"]}
        await it.begin()
        it.speed_mps = 0.4
        await it.service.advance(0.1)
        begun = it.service.tester.spawn(it.ask("drive", "", instead=True))
        await it.service.advance(0.5)
        assert not begun.done()
        assert it.state().task == "fetch"
        it.speed_mps = 0.0
        await it.service.until(begun.done)
        assert begun.result().accepted


@in_virtual_time
async def test_a_task_that_cannot_start_does_not_end_the_running_one() -> None:
    async with robot() as it:
        it.script = {"search": ["never"]}
        fetch = await it.begin()
        for refused in (
            await it.ask("fetch", "no_such_can", instead=True),
            await it.ask("put-down", "", instead=True),
            await it.ask("drive", "", instead=True, asker="nobody"),
        ):
            assert not refused.accepted
        await it.service.advance(0.3)
        assert (it.state().task_id, it.state().outcome) == (fetch, None)


@in_virtual_time
async def test_of_several_who_want_the_robot_instead_the_last_has_it() -> None:
    async with robot() as it:
        it.script = {"search": ["never"] * 3, "drive": ["never"] * 3}
        await it.begin()
        asking = [it.service.tester.spawn(it.ask("drive", "", instead=True)) for _ in range(3)]
        await it.service.until(lambda: all(one.done() for one in asking))
        assert all(one.result().accepted for one in asking)
        await it.service.advance(0.3)
        assert it.state().task_id == max((one.result().task_id for one in asking), key=lambda name: int(name[-1]))
        assert it.state().outcome is None


@in_virtual_time
async def test_a_drive_that_is_left_alone_ends_and_says_so() -> None:
    async with driven() as it:
        tick = (await give(it, 0)).tick
        await it.service.advance(LEFT_ALONE_S - 5.0)
        tick = (await give(it, (await give(it, tick)).tick)).tick  # counts as the last input
        for _ in range(int(LEFT_ALONE_S) - 5):
            await it.service.advance(1.0)
            tick = (await give(it, tick, Motion())).tick
        assert it.state().outcome is None
        await it.service.advance(6.0)
        state = it.state()
        assert (state.outcome, state.reason) == ("done", "left_alone: nothing was driven for 60 s")
        assert "left_alone" in (await give(it, tick)).text
        assert idle_again(it)


@in_virtual_time
async def test_the_death_of_the_driver_ends_the_drive() -> None:
    async with robot() as it:
        it.script = {"drive": ["never"]}
        token = it.service.tester.bus.declare_alive(asker_key("calliope", "ada"))
        await it.begin("drive", "", asker="ada")
        tick = (await give(it, 0)).tick
        await give(it, tick)
        token.close()
        await it.service.settle()
        assert moves(it) is None
        state = await it.outcome()
        assert state.outcome == "cancelled"
        assert state.reason.startswith("asker_gone: ")


@in_virtual_time
async def test_while_the_planner_is_gone_no_motion_counts_and_the_answer_says_what_it_waits_for() -> None:
    async with driven(contact=Contact()) as it:
        tick = (await give(it, 0)).tick
        tick = (await give(it, tick)).tick
        it.service.other_dies("planning")
        it.silent = True
        await it.service.advance(0.1)
        reply = await give(it, tick)
        assert reply.refusal == "waiting"
        assert "planning" in reply.text
        assert moves(it) is None
        it.silent = False
        it.service.others_live("planning")
        await it.service.until(lambda: it.service.latest(topics.INTENT).action.name != "idle")
        tick = (await give(it, reply.tick)).tick
        assert (await give(it, tick)).accepted


@in_virtual_time
async def test_without_perception_the_drive_goes_on() -> None:
    async with driven(contact=Contact()) as it:
        it.service.other_dies("perception")
        await it.service.advance(0.5)
        tick = (await give(it, 0)).tick
        assert (await give(it, tick)).accepted


# --- the client's side ----------------------------------------------------------------------------


@in_virtual_time
async def test_a_client_holds_a_motion_for_as_long_as_it_is_renewed() -> None:
    async with driven() as it, Driving(it.service.tester, it.task_id) as driving:
        for _ in range(30):
            driving.motion = AHEAD
            await it.service.advance(0.05)
            assert moves(it) == AHEAD
        await it.service.advance(HOLD_S + 0.05)
        assert driving.motion.zero
        assert moves(it) is None


@in_virtual_time
async def test_a_client_that_wants_rest_is_obeyed_at_once() -> None:
    async with driven() as it, Driving(it.service.tester, it.task_id) as driving:
        driving.motion = AHEAD
        await it.service.advance(0.1)
        driving.motion = Motion()
        await it.service.settle()
        assert moves(it) is None
        driving.motion = AHEAD
        await it.service.settle()
        assert moves(it) == AHEAD


@in_virtual_time
async def test_a_client_that_leaves_brings_the_robot_to_rest() -> None:
    async with driven() as it:
        async with Driving(it.service.tester, it.task_id) as driving:
            driving.motion = AHEAD
            await it.service.advance(0.1)
            assert moves(it) == AHEAD
        await it.service.settle()
        assert moves(it) is None


@in_virtual_time
async def test_a_client_learns_that_the_task_has_ended_also_while_nothing_is_held() -> None:
    async with driven() as it, Driving(it.service.tester, it.task_id) as driving:
        await it.service.advance(1.0)
        assert not driving.over.is_set()
        await it.estop(latched=True)
        await it.service.advance(1.0)
        assert driving.over.is_set()
        assert "estop" in driving.reply.text


@in_virtual_time
async def test_a_client_whose_executive_does_not_answer_says_so_and_goes_on_when_it_does() -> None:
    async with driven() as it, Driving(it.service.tester, it.task_id) as driving:
        await it.service.advance(0.1)
        await it.service.kill()
        driving.motion = AHEAD
        await it.service.tester.sleep(1.0)
        assert "executive" in driving.trouble
        assert not driving.reply.accepted
