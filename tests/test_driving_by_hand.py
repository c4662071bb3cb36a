"""Driving by hand in the whole robot, judged by the true state: how soon it is at rest when its driver is lost, that it
runs into nothing, and that a can is picked up by hand."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from math import atan2, cos, hypot, sin

import pytest
from robot_rig import HALTED_MPS, RobotRig, yaw_of

from cocoro import topics
from cocoro.driving import Driving
from cocoro.messages import DriveRequest, Motion, Truth
from cocoro.testing import in_virtual_time

pytestmark = pytest.mark.sim

FAST = Motion(speed_mps=1.0)
FAST_MPS = 0.44
REST_S = 0.45
"""From the last input that counted to the rest of the body, at full speed."""
ZERO_S = 0.30
"""From the last input that counted to a wheel command of zero, where the planner lives."""


async def hold(rig: RobotRig, driving: Driving, motion: Motion, until: Callable[[], bool], timeout_s: float) -> None:
    """Hold a motion until a condition is met or time is up, as a held key does."""
    end_s = rig.now_s + timeout_s
    while not until() and rig.now_s < end_s:
        driving.motion = motion
        await rig.advance(0.04)


async def fast(rig: RobotRig) -> Driving:
    """A driver whose robot drives at full speed. He holds nothing any more when this returns."""
    driving = Driving(rig.operator, await rig.begin("drive"))
    await driving.__aenter__()
    await hold(rig, driving, FAST, lambda: rig.speed_mps > FAST_MPS, 10.0)
    assert rig.speed_mps > FAST_MPS
    return driving


async def at_rest_after(rig: RobotRig, since_s: float) -> float:
    """Time from `since_s` until the body stands for good, by the true state, s."""
    await rig.advance(1.5)
    moving = [b.stamp_ns for a, b in zip(rig.truths, rig.truths[1:], strict=False) if _speed(a, b) > HALTED_MPS]
    return moving[-1] / 1e9 - since_s


def _speed(a: Truth, b: Truth) -> float:
    way_m = hypot(b.body_m[0] - a.body_m[0], b.body_m[1] - a.body_m[1])
    return way_m / ((b.stamp_ns - a.stamp_ns) / 1e9)


def about_arm(rig: RobotRig, place_m: tuple[float, float, float]) -> tuple[float, float]:
    """Distance, m, and azimuth, rad, of a place in the world from the arm's axis, by the true pose of the body."""
    truth = rig.truths[-1]
    yaw_rad = yaw_of(truth)
    x, y = place_m[0] - truth.body_m[0], place_m[1] - truth.body_m[1]
    axis = rig.robot.chain("arm_base").position({"arm_base": 0.0})
    ahead = cos(yaw_rad) * x + sin(yaw_rad) * y - axis[0]
    left = -sin(yaw_rad) * x + cos(yaw_rad) * y - axis[1]
    return hypot(ahead, left), atan2(left, ahead)


async def _stops_asking(rig: RobotRig, driving: Driving) -> None:
    """The driver's program freezes."""
    assert driving._work is not None
    driving._work.cancel()


async def _lets_go(rig: RobotRig, driving: Driving) -> None:
    driving.motion = Motion()


async def _executive_dies(rig: RobotRig, driving: Driving) -> None:
    await rig.kill("executive")


async def _planner_dies(rig: RobotRig, driving: Driving) -> None:
    await rig.kill("planning")


async def _emergency_stop(rig: RobotRig, driving: Driving) -> None:
    await rig.estop(latched=True)


@pytest.mark.parametrize(
    "lose", [_stops_asking, _lets_go, _executive_dies, _planner_dies, _emergency_stop], ids=lambda lose: lose.__name__
)
def test_a_robot_that_lost_its_driver_at_full_speed_is_at_rest_in_time(
    lose: Callable[[RobotRig, Driving], Awaitable[None]],
) -> None:
    @in_virtual_time
    async def lost() -> None:
        async with RobotRig(settings={"sim": {"width": 320, "height": 240, "frame_rate_hz": 15.0}}) as rig:
            driving = await fast(rig)
            driving.motion = FAST
            await rig.advance(0.0)
            last_s = rig.now_s
            await lose(rig, driving)
            rest_s = await at_rest_after(rig, last_s)
            print(f"{lose.__name__}: at rest after {rest_s:.3f} s")
            assert rest_s < REST_S
            if lose is not _planner_dies:
                assert all(command == (0.0, 0.0) for command in rig.commanded_since(last_s + ZERO_S))
            if driving._work is not None:
                driving._work.cancel()

    lost()


@in_virtual_time
async def test_an_input_that_waited_on_its_way_does_not_move_a_robot_at_rest() -> None:
    async with RobotRig() as rig:
        task_id = await rig.begin("drive")
        tick = (await rig.operator.call(topics.DRIVE, DriveRequest(task_id=task_id))).tick
        await rig.advance(0.5)
        since_s = rig.now_s
        reply = await rig.operator.call(topics.DRIVE, DriveRequest(task_id=task_id, tick=tick, motion=FAST))
        await rig.advance(1.0)
        assert not reply.accepted
        assert max(rig.speeds_since(since_s)) < HALTED_MPS


@in_virtual_time
async def test_whoever_holds_the_way_ahead_does_not_run_into_the_can() -> None:
    async with RobotRig() as rig:
        async with Driving(rig.operator, await rig.begin("drive")) as driving:
            await hold(rig, driving, FAST, lambda: False, 12.0)
            assert driving.reply.accepted
        x, y, _ = rig.thing("red_can").position_m
        body_m = rig.truths[-1].body_m
        assert hypot(x - 1.5, y) < 0.05  # it stands where it stood
        left_m = hypot(x - body_m[0], y - body_m[1]) - 0.165 - 0.033
        assert 0.0 < left_m < 0.25
        assert rig.speed_mps < HALTED_MPS


@in_virtual_time
async def test_an_operator_picks_up_a_can_by_hand() -> None:
    async with RobotRig() as rig:
        plan = rig.operator.latest(topics.PLAN)
        axis = rig.robot.chain("arm_base").position({"arm_base": 0.0})

        def can() -> tuple[float, float]:
            return about_arm(rig, rig.thing("red_can").position_m)

        def hand() -> tuple[float, float, float]:
            assert plan.value is not None
            assert plan.value.hand_m is not None
            x, y, z = plan.value.hand_m
            return hypot(x - axis[0], y - axis[1]), atan2(y - axis[1], x - axis[0]), z

        def unfolded() -> bool:
            return hand()[0] > 0.35 and abs(hand()[1]) < 0.1

        async with Driving(rig.operator, await rig.begin("drive")) as driving:
            await hold(rig, driving, Motion(speed_mps=0.4), lambda: can()[0] < 0.7, 20.0)
            await hold(rig, driving, Motion(speed_mps=0.06), lambda: can()[0] < 0.50, 20.0)
            await hold(rig, driving, Motion(up_mps=0.001, grip="open"), unfolded, 10.0)
            await rig.advance(1.0)
            side = 1 if can()[1] > hand()[1] else -1
            turn = Motion(round_radps=0.1 * side)
            await hold(rig, driving, turn, lambda: side * (can()[1] - hand()[1]) < 0.0, 10.0)
            await hold(rig, driving, Motion(up_mps=-0.1), lambda: hand()[2] < 0.07, 10.0)
            await hold(rig, driving, Motion(out_mps=0.05), lambda: hand()[0] > can()[0] - 0.005, 10.0)
            await hold(rig, driving, Motion(grip="close"), lambda: bool(plan.value and plan.value.holding), 4.0)
            await hold(rig, driving, Motion(up_mps=0.1), lambda: hand()[2] > 0.15, 5.0)
            await rig.advance(0.5)
            assert rig.held("red_can")
            assert rig.thing("red_can").position_m[2] > 0.1
            height_m = rig.thing("red_can").position_m[2]
            await hold(rig, driving, Motion(speed_mps=-0.05, turn_radps=0.3), lambda: False, 2.0)
            assert rig.held("red_can")  # and it drives with it
            assert rig.thing("red_can").position_m[2] == pytest.approx(height_m, abs=0.02)
