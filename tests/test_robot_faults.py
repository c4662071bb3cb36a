"""The whole robot, and what can go wrong with it, judged by the simulator's truth."""

from __future__ import annotations

from itertools import pairwise
from math import cos, pi
from typing import Any

import pytest
from robot_rig import HALTED_MPS, RobotRig

from cocoro import topics
from cocoro.messages import BaseCommand, PlannerStatus, ServoCommand
from cocoro.testing import in_virtual_time
from cocoro.topics import Topic
from deploy.processes import hardware

pytestmark = pytest.mark.sim

HALT_S = 0.3
"""Bound from a fault until the robot stands, by the true state."""
ZERO_S = 0.2
"""Bound from a fault until only zero is commanded."""


def stands_since(rig: RobotRig, when_s: float) -> bool:
    return max(rig.speeds_since(when_s)) < HALTED_MPS


def zero_commanded_since(rig: RobotRig, when_s: float) -> bool:
    """Whether the wheels were commanded to stand, by the planner's commands or by the base that hears none."""
    return not any(left or right for left, right in rig.commanded_since(when_s)) and (
        bool(rig.commanded_since(when_s)) or not rig.base_obeys_since(when_s)
    )


# --- the emergency stop ---------------------------------------------------------------------------


@in_virtual_time
async def test_the_emergency_stop_halts_a_driving_robot_and_holds_it_until_it_is_reset() -> None:
    async with RobotRig() as rig:
        task_id = await rig.driving()
        pressed_s = rig.now_s
        assert await rig.estop(latched=True) == {"base", "arm", "hand", "executive"}
        await rig.advance(1.0)
        assert stands_since(rig, pressed_s + HALT_S)
        assert rig.turned_since(pressed_s + HALT_S) < 0.01
        state = rig.state(task_id)
        assert (state.outcome, state.reason) == ("failed", "estop: emergency stop by test")

        for task, label in (("fetch", "red_can"), ("park", ""), ("put-down", "")):
            refused = await rig.ask(task, label)
            assert refused.refusal == "estop"
            assert "cocoro reset" in refused.text
        await rig.advance(1.0)
        assert stands_since(rig, pressed_s + HALT_S)

        assert await rig.estop(latched=False) == {"base", "arm", "hand", "executive"}
        await rig.advance(1.0)
        assert stands_since(rig, pressed_s + HALT_S), "a reset alone moves nothing"
        assert (await rig.run("fetch", "red_can")).outcome == "done"
        assert rig.held("red_can")


@in_virtual_time
async def test_the_grip_survives_the_emergency_stop_and_what_is_held_can_be_put_down_after_it() -> None:
    async with RobotRig() as rig:
        await rig.holding()
        lifted_m = rig.thing("red_can").position_m[2]
        await rig.estop(latched=True)
        await rig.advance(5.0)
        assert rig.held("red_can")
        assert rig.thing("red_can").position_m[2] == pytest.approx(lifted_m, abs=0.02)
        await rig.estop(latched=False)
        await rig.advance(1.0)
        assert rig.held("red_can")
        assert (await rig.ask("fetch", "red_can")).refusal == "holding"

        assert (await rig.run("put-down")).outcome == "done"
        await rig.advance(1.0)
        can = rig.thing("red_can")
        assert can.touching == ("floor",)
        assert can.position_m[2] == pytest.approx(0.06, abs=0.002)
        x, y, _, _ = can.orientation
        assert 1 - 2 * (x * x + y * y) > cos(pi / 60), "it stands"
        assert (await rig.ask("put-down")).refusal == "not_holding"


@in_virtual_time
async def test_a_stop_is_remembered_by_whoever_is_left() -> None:
    async with RobotRig() as rig:
        await rig.driving()
        await rig.kill("executive")
        await rig.estop(latched=True)
        await rig.start("executive")
        await rig.advance(2.0)
        assert (await rig.ask("fetch", "red_can")).refusal == "estop"
        await rig.estop(latched=False)
        await rig.advance(1.0)
        assert (await rig.ask("fetch", "red_can")).accepted


@in_virtual_time
async def test_hardware_that_knows_of_no_latch_stands_still_until_the_executive_has_spoken() -> None:
    async with RobotRig(services=("sim",)) as rig:

        async def command(seconds: float) -> None:
            for _ in range(round(seconds / 0.02)):
                nod = ServoCommand(joints=("neck_tilt",), goal_rad=(-0.5,), speed_radps=(2.0,))
                rig.operator.publish(topics.ARM_COMMAND, nod)
                rig.operator.publish(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.3, turn_radps=0.0))
                await rig.advance(0.02)

        await command(1.0)
        assert stands_since(rig, 0.0)
        assert abs(rig.truths[-1].joints_rad["neck_tilt"]) < 0.01
        await rig.start("executive")
        await command(2.0)
        assert rig.speed_mps > 0.25
        assert rig.truths[-1].joints_rad["neck_tilt"] == pytest.approx(-0.5, abs=0.05)


# --- cancelling -----------------------------------------------------------------------------------


@in_virtual_time
async def test_a_cancelled_drive_leaves_the_robot_standing() -> None:
    async with RobotRig() as rig:
        task_id = await rig.driving()
        cancelled_s = rig.now_s
        assert (await rig.cancel()).task_id == task_id
        state = await rig.outcome(task_id)
        assert (state.outcome, state.reason) == ("cancelled", "by the operator")
        said_s = rig.now_s
        await rig.advance(1.0)
        assert max(rig.speeds_since(said_s)) < HALTED_MPS, "it is still when it says so"
        assert stands_since(rig, cancelled_s + HALT_S)
        assert (await rig.cancel()).refusal == "no_task"


# --- services that die ----------------------------------------------------------------------------


@pytest.mark.parametrize("service", ["planning", "executive", "perception"])
def test_who_dies_while_driving_leaves_a_robot_that_stands(service: str) -> None:
    """While it speeds up; at full speed: test_faults_speed."""

    @in_virtual_time
    async def scenario() -> None:
        async with RobotRig() as rig:
            task_id = await rig.driving(0.15)
            died_s = rig.now_s
            await rig.kill(service)
            await rig.advance(1.5)
            assert zero_commanded_since(rig, died_s + ZERO_S)
            assert stands_since(rig, died_s + HALT_S)
            if service != "executive":
                assert (rig.state(task_id).outcome, rig.state(task_id).text) == (None, f"lost contact with {service}")
                state = await rig.outcome(task_id)
                assert (state.outcome, state.reason) == ("failed", f"not_alive: lost contact with {service}")
                assert stands_since(rig, died_s + HALT_S)
                refused = await rig.ask("fetch", "red_can")
                assert (refused.refusal, refused.text) == ("not_alive", f"no contact with {service}; see cocoro status")

            await rig.start(service)
            await rig.advance(2.0)
            assert stands_since(rig, died_s + HALT_S), "who comes back waits to be asked"
            assert (await rig.run("fetch", "red_can")).outcome == "done"
            assert rig.held("red_can")

    scenario()


@in_virtual_time
async def test_a_planner_that_dies_with_a_can_in_the_hand_drops_nothing_and_its_successor_can_put_it_down() -> None:
    async with RobotRig() as rig:
        await rig.holding()
        await rig.kill("planning")
        await rig.advance(3.0)
        assert rig.held("red_can")
        await rig.start("planning")
        await rig.advance(2.0)
        assert rig.held("red_can")
        assert (await rig.run("put-down")).outcome == "done"
        await rig.advance(0.5)
        assert rig.thing("red_can").touching == ("floor",)


@in_virtual_time
async def test_when_the_robot_itself_dies_the_task_says_so() -> None:
    async with RobotRig() as rig:
        task_id = await rig.driving()
        await rig.kill("sim")
        state = await rig.outcome(task_id, timeout_s=15.0)
        assert state.outcome == "failed"
        assert state.reason == f"not_alive: lost contact with {', '.join(sorted(hardware()))}"


# --- slow services --------------------------------------------------------------------------------


@in_virtual_time
async def test_slow_perception_slows_no_command() -> None:
    async with RobotRig(latency_s={"perception": 0.5}) as rig:
        await rig.driving(0.1)
        start_s = rig.now_s
        await rig.advance(2.0)
        moving: tuple[Topic[Any], ...] = (topics.BASE_COMMAND, topics.ARM_COMMAND, topics.HAND_COMMAND)
        for topic in moving:
            at_ms = [message.stamp_ns / 1e6 for message in rig.tap.messages(topic) if message.stamp_ns > start_s * 1e9]
            assert len(at_ms) >= 99
            assert max(after - before for before, after in pairwise(at_ms)) == pytest.approx(20.0)
        seen = [m for m in rig.tap.messages(topics.DETECTIONS) if m.stamp_ns > start_s * 1e9]
        assert 2 <= len(seen) <= 5


# --- refusals -------------------------------------------------------------------------------------


@in_virtual_time
async def test_what_cannot_be_done_is_refused_in_words() -> None:
    async with RobotRig() as rig:
        await rig.begin("park")
        busy = await rig.ask("fetch", "red_can")
        assert (busy.refusal, busy.text) == ("busy", "park is running; cancel it first (cocoro cancel)")
        unknown = await rig.ask("fetch", "teapot")
        assert unknown.refusal == "unknown_label"
        assert all(label in unknown.text for label in ("teapot", "red_can", "green_can", "blue_can"))
        assert (await rig.ask("fetch", "magenta_marker")).refusal == "unknown_label"


@in_virtual_time
async def test_a_task_that_takes_too_long_is_ended_and_the_robot_stands() -> None:
    async with RobotRig() as rig:
        state = await rig.outcome(await rig.begin("fetch", "red_can", timeout_s=2.0))
        assert (state.outcome, state.reason) == ("failed", "timed_out: the task took over 2 s")
        end_s = rig.now_s
        await rig.advance(1.0)
        assert stands_since(rig, end_s)


@in_virtual_time
async def test_the_planner_says_why_it_does_what_it_does() -> None:
    async with RobotRig() as rig:
        await rig.driving(0.2)
        statuses: list[PlannerStatus] = rig.tap.messages(topics.PLAN)
        assert all(status.why for status in statuses)
        assert "m to drive" in statuses[-1].why
        assert statuses[-1].target is not None
        assert statuses[-1].target.label == "red_can"
