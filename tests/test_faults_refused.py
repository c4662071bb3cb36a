"""A robot that is not fit for a task begins none: a low battery, a planner that knows nothing yet."""

from __future__ import annotations

import pytest
from robot_rig import SMALL_FRAMES, RobotRig
from spelled import asked

from cocoro import topics
from cocoro.messages import BaseState, PlannerStatus, ServoState, TaskReply
from cocoro.testing import ServiceUnderTest, in_virtual_time
from cocoro.units import Vec2
from deploy.processes import hardware

LOW = 0.15


async def executive(
    service: ServiceUnderTest, battery_fraction: float, *, holding: bool = False, body_m: Vec2 | None = (0.0, 0.0)
) -> None:
    """Have it know of a robot that is released and able, with so much in its battery."""
    service.others_live(*hardware(), "perception", "planning")
    here = BaseState(
        odometry_m=(0.0, 0.0), odometry_yaw_rad=0.0, speed_mps=0.0, turn_rate_radps=0.0,
        battery_fraction=battery_fraction, latch="released",
    )  # fmt: skip
    service.feed(topics.BASE_STATE, here)
    for network in (topics.ARM_STATE, topics.HAND_STATE):
        service.feed(network, ServoState(joints=(), position_rad=(), speed_radps=(), load=(), latch="released"))
    service.feed(topics.PLAN, PlannerStatus(why="nothing is asked", holding=holding, body_m=body_m))
    await service.settle()


async def ask(service: ServiceUnderTest, task: str, label: str = "") -> TaskReply:
    return await service.ask(topics.RUN, asked(task, label))


@in_virtual_time
async def test_with_a_low_battery_no_task_starts_and_the_refusal_says_so() -> None:
    async with ServiceUnderTest("services.executive.service") as service:
        await executive(service, LOW - 0.01)
        tasks: tuple[tuple[str, str], ...] = (("fetch", "red_can"), ("follow", "red_can"), ("park", ""))
        for task, label in tasks:
            refused = await ask(service, task, label)
            assert (refused.accepted, refused.refusal) == (False, "battery")
            assert refused.text == "the battery is low (14%); charge the robot first"


@in_virtual_time
async def test_what_the_hand_holds_can_be_put_down_with_a_low_battery() -> None:
    async with ServiceUnderTest("services.executive.service") as service:
        await executive(service, 0.01, holding=True)
        assert (await ask(service, "put-down")).accepted


@in_virtual_time
async def test_as_much_as_the_limit_is_enough_and_the_limit_can_be_set() -> None:
    async with ServiceUnderTest("services.executive.service") as service:
        await executive(service, LOW)
        assert (await ask(service, "park")).accepted
    async with ServiceUnderTest("services.executive.service", {"battery_low": 0.5}) as service:
        await executive(service, 0.49)
        assert (await ask(service, "park")).refusal == "battery"


@in_virtual_time
async def test_a_battery_that_gets_low_ends_no_task() -> None:
    async with ServiceUnderTest("services.executive.service") as service:
        await executive(service, LOW)
        assert (await ask(service, "park")).accepted
        await executive(service, LOW - 0.01)
        assert service.latest(topics.TASK).outcome is None
        assert (await ask(service, "park")).refusal == "busy"


@pytest.mark.sim
@in_virtual_time
async def test_the_simulated_base_says_how_full_its_battery_is() -> None:
    async with RobotRig(settings={"sim": SMALL_FRAMES | {"battery_fraction": 0.1}}) as rig:
        await rig.advance(1.5)
        assert rig.tap.messages(topics.BASE_STATE)[-1].battery_fraction == 0.1
        assert (await rig.ask("fetch", "red_can")).refusal == "battery"


@in_virtual_time
async def test_a_planner_that_does_not_know_where_the_robot_stands_is_not_ready_for_a_task() -> None:
    async with ServiceUnderTest("services.executive.service") as service:
        await executive(service, 1.0, body_m=None)
        refused = await ask(service, "fetch", "red_can")
        assert (refused.refusal, refused.text) == (
            "not_alive", "the planner does not know yet where the robot stands (nothing is asked)",
        )  # fmt: skip
        await executive(service, 1.0)
        assert (await ask(service, "fetch", "red_can")).accepted
