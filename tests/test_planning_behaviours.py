"""The planner's behaviours: how each ends, and what it says of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from planner_rig import ROBOT, Planner, standing, started

from apps.rehearsal.lockstep import LockstepPlanner
from cocoro import topics
from cocoro.frames import Pose2
from cocoro.messages import PlannerStatus
from cocoro.messages.actions import Approach
from services.planning.behaviours.driving import Approaching
from services.planning.config import PlanningConfig
from services.planning.core import PlanningCore


@pytest.fixture
def planner() -> Planner:
    return started()


def test_search_is_done_when_what_it_seeks_is_in_view(planner: Planner) -> None:
    planner.want("search", "red_can")
    status = planner.run(0.2)
    assert (status.state, status.why) == ("done", "red_can is in view")
    assert standing(planner)


def test_search_that_finds_nothing_looks_everywhere_and_says_so(planner: Planner) -> None:
    planner.sees = None
    planner.want("search", "blue_can")
    pans = []
    for _ in range(4000):
        status = planner.tick()
        pans.append(planner.angles["neck_pan"])
        if status.state != "running":
            break
    assert (status.state, status.reason) == ("failed", "not_found")
    assert (min(pans), max(pans)) == pytest.approx((-2.6, 2.6), abs=0.1)


def test_a_search_whose_time_is_up_says_what_it_has_not_seen(planner: Planner) -> None:
    planner.sees = None
    planner.want("search", "blue_can")
    planner.run(0.2)
    planner.want("explore", "blue_can", time_is_up=True)
    status = planner.tick()
    assert (status.state, status.reason) == ("failed", "not_found")
    assert "time is up" in status.why
    assert "m2 at" in status.why
    assert standing(planner)


def test_a_base_that_restarts_begins_the_search_anew(planner: Planner) -> None:
    planner.sees = None
    planner.want("search", "blue_can")
    planner.run(0.1)
    planner.incarnation += 1
    status = planner.run(0.1)
    assert status.state == "running"
    assert status.why.startswith("sweeping for blue_can")


def test_a_restart_while_exploring_lets_the_search_begin_anew_and_claims_nothing(planner: Planner) -> None:
    planner.sees = None
    planner.want("search", "blue_can")
    planner.run(0.2)
    planner.want("explore", "blue_can")
    planner.incarnation += 1
    status = planner.tick()
    assert (status.state, status.why) == ("done", "the search begins anew")
    planner.want("explore", "blue_can", time_is_up=True)
    status = planner.tick()
    assert (status.state, status.reason) == ("failed", "not_found")
    assert "which floor was seen is not known" in status.why


def test_approach_to_what_was_never_seen_is_lost(planner: Planner) -> None:
    planner.want("approach", "blue_can")
    assert planner.tick().reason == "lost"
    assert standing(planner)


def test_the_arm_unfolds_before_the_robot_turns_to_where_there_is_no_room_for_it(planner: Planner) -> None:
    core = planner.under_test.core
    assert isinstance(core, PlanningCore)
    approaching = Approaching(Approach(label="red_can"))
    approaching._course = cast(Any, SimpleNamespace(roomy=lambda pose, _: abs(pose.yaw_rad) < 0.3))
    snapshot = cast(Any, SimpleNamespace(actuators=core.actuators, body=Pose2()))
    for place, room in (((1.5, -0.1, 0.06), True), ((0.2, 0.5, 0.06), False)):
        assert approaching._room_ahead(snapshot, cast(Any, SimpleNamespace(position_m=place)), cast(Any, None)) is room


def test_reaching_for_what_is_too_far_is_unreachable(planner: Planner) -> None:
    planner.want("reach", "red_can")
    status = planner.tick()
    assert (status.state, status.reason) == ("failed", "unreachable")
    assert "its radius is" in status.why


def test_a_step_that_has_ended_keeps_its_result_until_another_is_asked_for(planner: Planner) -> None:
    planner.want("reach", "red_can")
    planner.tick()
    assert planner.run(1.0).reason == "unreachable"
    assert standing(planner)
    planner.want("search", "red_can")
    assert planner.run(0.2).state == "done"


def test_claws_that_close_on_nothing_have_no_grip(planner: Planner) -> None:
    planner.want("grasp")
    status = planner.run(2.5)
    assert (status.state, status.reason, status.holding) == ("failed", "no_grip", False)


def test_claws_that_are_stopped_hold_something_and_push_on_a_little(planner: Planner) -> None:
    planner.want("grasp")
    planner.run(0.1)
    stopped = {claw: sign * 0.05 for claw, sign in ROBOT.claw.open_sign.items()}
    config = PlanningConfig().hand
    for _ in range(40):
        planner.angles |= stopped
        planner.hand_load = 0.5
        status = planner.tick()
    assert (status.state, status.holding) == ("done", True)
    hand = planner.under_test.latest(topics.HAND_COMMAND)
    goals = dict(zip(hand.joints, hand.goal_rad, strict=True))
    for claw, sign in ROBOT.claw.open_sign.items():
        assert sign * goals[claw] == pytest.approx(0.05 - config.clamp_rad, abs=0.01)


def test_what_settles_between_the_claws_as_it_is_lifted_is_no_slip(planner: Planner) -> None:
    stopped = {claw: sign * 0.05 for claw, sign in ROBOT.claw.open_sign.items()}

    def run(seconds: float, load: float) -> PlannerStatus:
        for _ in range(round(seconds / 0.02)):
            planner.angles |= stopped
            planner.hand_load = load
            status = planner.tick()
        return status

    planner.want("grasp")
    assert run(0.8, 0.5).state == "done"
    planner.want("lift")
    run(0.04, 0.5)
    run(0.12, 0.0)
    assert run(0.24, 0.5).state == "running", "loose for longer than a slip, but pressed again"
    assert run(0.4, 0.0).reason == "slipped"


def test_in_lock_step_it_plans_once_a_cycle_and_keeps_the_arm_back(planner: Planner) -> None:
    core = LockstepPlanner(ROBOT, PlanningConfig())
    assert core.schedule.rate_hz is None
    assert core.schedule.triggers == (topics.DETECTIONS,)
    lockstep = started(make=LockstepPlanner)
    lockstep.want("approach", "red_can")
    lockstep.run(3.0)
    planner.want("approach", "red_can")
    planner.run(3.0)
    park = ROBOT.poses["park"]
    assert {name: lockstep.angles[name] for name in park} == pytest.approx(park, abs=0.05)
    assert planner.angles["arm_base"] < 0.5, "meanwhile the other one has unfolded"
