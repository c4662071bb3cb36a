"""Driving to a place on the floor, and putting down at one."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, pi, sin

import pytest
from executive_rig import robot
from planner_rig import Planner, started
from robot_rig import RobotRig
from spelled import asked

from cocoro import topics
from cocoro.messages import Obstacles, PlannerStatus
from cocoro.testing import in_virtual_time
from services.executive.tasks import GoThereTask, PutDownTask
from services.planning.behaviours.going_there import GoingThere

NEAR_M = GoingThere.NEAR_ENOUGH_M + 0.02  # and what it coasts


def standing_at(places_m: Sequence[tuple[float, float]]) -> Planner:
    """A planner before whose robot things of 0.3 m height stand at places, body frame."""
    planner = started()
    planner.sees, planner.silent = None, {"perception/obstacles"}
    for _ in range(8):  # as often as it saw free floor there before, and more
        stand = Obstacles(points_m=tuple((x, y, 0.3) for x, y in places_m), lowest_m=(0.02,) * len(places_m))
        planner.under_test.feed(topics.OBSTACLES, stand, incarnation=planner.incarnation)
        planner.tick()
    return planner


def until_over(planner: Planner, seconds: float = 10.0) -> PlannerStatus:
    status = planner.tick()
    for _ in range(round(seconds / 0.02)):
        if status.state != "running":
            return status
        status = planner.tick()
    return status


def test_it_drives_to_the_place_and_looks_there() -> None:
    planner = standing_at([])
    planner.want("go-there", place_m=(1.2, 0.0))
    status = planner.run(1.0)
    assert status.state == "running"
    assert status.distance_m == pytest.approx(1.2, abs=0.01)
    assert planner.wheels.ahead_mps > 0.1
    assert planner.wheels.turn_radps == pytest.approx(0.0, abs=0.04)
    assert -0.9 < planner.angles["neck_tilt"] < -0.2, "it looks down at the floor before it"


def test_it_is_done_where_it_stands() -> None:
    planner = standing_at([])
    planner.want("go-there", place_m=(0.02, -0.02))
    assert planner.run(0.1).state == "done"


def test_where_something_stands_there_is_no_room_and_it_says_how_much_there_is() -> None:
    planner = standing_at([(1.22, 0.02)])
    planner.want("go-there", place_m=(1.3, 0.02))
    assert planner.run(1.0).state == "running", "what was seen from one side may be wrong"
    assert planner.wheels.ahead_mps == 0.0
    status = until_over(planner)
    assert (status.state, status.reason) == ("failed", "unreachable")
    assert "no room at (1.30, 0.02)" in status.why
    assert "the robot needs 0.2" in status.why


def test_a_place_within_a_ring_is_out_of_reach_and_it_stays_where_it_is() -> None:
    ring = [(2.6 + 0.6 * cos(k * pi / 40), 0.6 * sin(k * pi / 40)) for k in range(80)]
    planner = standing_at(ring)
    planner.want("go-there", place_m=(2.6, 0.0))
    status = until_over(planner)
    assert (status.state, status.reason) == ("failed", "unreachable")
    assert "no way to (2.60, 0.00)" in status.why
    assert all(
        output.message.ahead_mps <= 0.0  # type: ignore[attr-defined]
        for step in planner.under_test.steps
        for output in step
        if output.topic is topics.BASE_COMMAND
    )


@in_virtual_time
async def test_a_place_too_far_away_is_refused_with_the_distance_that_it_goes() -> None:
    async with robot() as it:
        await it.begin("go-there", "", x_m=30.0, y_m=0.0)
        state = await it.outcome()
        assert (state.outcome, set(it.asked)) == ("failed", {"idle"})
        assert "30.0 m away" in state.reason
        assert "within 10 m" in state.reason


@in_virtual_time
async def test_what_the_hand_holds_is_carried_to_the_place_and_put_down_there() -> None:
    async with robot() as it:
        it.holding = True
        await it.service.advance(0.1)
        await it.begin("put-down", "", x_m=1.0, y_m=0.5)
        assert (await it.outcome()).outcome == "done"
        assert [name for name in it.asked if name != "idle"] == ["carry", "place"]
        half = await it.ask("put-down", "", x_m=1.0)
        assert half.refusal == "bad_request"
        assert "both x and y" in half.text


def test_a_place_is_whole() -> None:
    with pytest.raises(ValueError, match="both x and y"):
        PutDownTask(y_m=1.0)
    assert GoThereTask(x_m=1.0, y_m=2.0).target == ""


@pytest.mark.sim
@in_virtual_time
async def test_the_robot_drives_round_the_can_to_the_place_behind_it() -> None:
    async with RobotRig() as rig:
        await rig.until(lambda: rig.truths)
        stood_m = rig.thing("red_can").position_m
        reply = await rig.operator.call(topics.RUN, asked("go-there", x_m=2.2, y_m=0.0))
        while reply.refusal in ("not_alive", "estop"):
            await rig.advance(0.05)
            reply = await rig.operator.call(topics.RUN, asked("go-there", x_m=2.2, y_m=0.0))
        state = await rig.outcome(reply.task_id)
        assert state.outcome == "done", state.reason
        await rig.advance(0.5)
        x, y, _ = rig.truths[-1].body_m
        assert hypot(x - 2.2, y) < NEAR_M
        assert rig.thing("red_can").position_m == pytest.approx(stood_m, abs=0.001), "it did not touch the can"
        plans = rig.tap.messages(topics.FLOOR_PLAN)
        ways = [plan for plan in plans if plan.way_m]
        assert all(plan.goal_m == (2.2, 0.0) for plan in ways)
        assert max(abs(y) for plan in ways for _, y in plan.way_m) > 0.15, "the way leads round the can"


@pytest.mark.sim
@in_virtual_time
async def test_a_fetched_can_is_put_down_at_the_place_without_a_detour_round_itself() -> None:
    async with RobotRig() as rig:
        await rig.holding()
        begun_s = rig.now_s
        reply = await rig.operator.call(topics.RUN, asked("put-down", x_m=2.2, y_m=0.5))
        assert reply.accepted, reply.text
        state = await rig.outcome(reply.task_id)
        assert state.outcome == "done", state.reason
        x, y, z = rig.thing("red_can").position_m
        assert hypot(x - 2.2, y - 0.5) < 0.06
        assert z == pytest.approx(0.06, abs=0.01), "it stands on the floor"
        assert rig.now_s - begun_s < 15.0
