"""The servo service on one line that carries arm, hand and wheels, at its emulated end, in real time."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest
from one_line import LINE, WHEELS, its, one_line
from wire_servos import WHEEL, ServoBench, angle, inspected, moved

from cocoro import topics
from cocoro.messages import EstopRequest, ServoRequest
from services.servos.doctor import check
from services.servos.service import ServosConfig

pytestmark = [pytest.mark.zenoh, pytest.mark.alone]

ELBOW, CLAW = its("elbow"), its("claw_left")
NUMBER = {name: joint.id for name, joint in one_line().joints.items()}


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[ServoBench]:
    with ServoBench(tmp_path, protocol="feetech", robot=one_line()) as bench:
        for wheel in WHEELS:
            bench.put(NUMBER[wheel], **WHEEL["feetech"])
        yield bench


def test_both_groups_of_a_line_obey_and_report_each_for_itself(bench: ServoBench) -> None:
    near = 2 * bench.units.count_rad

    async def scenario() -> None:
        async with moved(bench) as servos:
            servos.move("arm", **{ELBOW: 0.6})
            servos.move("hand", **{CLAW: -0.3})
            arm = await servos.state("arm", lambda state: abs(angle(state, ELBOW) - 0.6) < near)
            hand = await servos.state("hand", lambda state: abs(angle(state, CLAW) + 0.3) < near)
            assert (arm.joints, hand.joints) == tuple(bench.robot.group_joints(group) for group in ("arm", "hand"))
            await servos.healthy("arm")
            await servos.healthy("hand")
            for wheel in WHEELS:
                assert bench.get(NUMBER[wheel], "torque_enable") == 0

    asyncio.run(asyncio.wait_for(scenario(), 60.0))


def test_a_stop_of_the_arm_leaves_the_hand_its_line(bench: ServoBench) -> None:
    async def scenario() -> None:
        async with moved(bench) as servos:
            servos.move("arm", **{ELBOW: 2.5})
            await servos.state("arm", lambda state: angle(state, ELBOW) > 0.3)
            reply = await servos.service.ask(topics.ESTOP.of("arm"), EstopRequest(by="test"))
            assert reply.latch == "latched"
            state = await servos.state("arm", lambda state: state.speed_radps[state.joints.index(ELBOW)] == 0.0)
            assert state.stopped_by == "estop"
            servos.move("hand", **{CLAW: -0.5})
            hand = await servos.state("hand", lambda state: angle(state, CLAW) < -0.45)
            assert hand.stopped_by == ""
            still = await servos.state("arm", lambda state: True)
            assert angle(still, ELBOW) == pytest.approx(angle(state, ELBOW), abs=0.02)

    asyncio.run(asyncio.wait_for(scenario(), 60.0))


def test_a_servo_that_is_silent_is_a_fault_of_its_own_group(bench: ServoBench) -> None:
    async def scenario() -> None:
        async with inspected(bench) as servos:
            bench.call(lambda: setattr(bench.servo(NUMBER[CLAW]), "mute", True))
            await servos.fault("hand", f"{CLAW} (ID {NUMBER[CLAW]}) does not answer")
            await servos.without("arm", "does not answer")
            relaxed = await servos.service.ask(
                topics.SERVOS.of("arm"), ServoRequest(action="relax", joints=(ELBOW,)), 10.0
            )
            assert relaxed.joints == (ELBOW,)
            assert bench.get(NUMBER[ELBOW], "torque_enable") == 0

    asyncio.run(asyncio.wait_for(scenario(), 60.0))


def test_the_doctor_looks_at_every_servo_of_the_line_and_lets_wheels_be_wheels(bench: ServoBench) -> None:
    config = ServosConfig(ports={LINE: bench.port(LINE)}, reply_s=0.2)
    assert {one.state for one in check(config, bench.robot, "robbie")} == {"ok"}
    wrong = ServosConfig(ports={**config.ports, "arm": "/dev/null"}, reply_s=0.2)
    assert [one.name for one in check(wrong, bench.robot, "robbie") if one.state == "bad"] == ["servo settings"]
    bench.put(NUMBER[ELBOW], **WHEEL["feetech"])
    bench.call(lambda: setattr(bench.servo(NUMBER[WHEELS[0]]), "mute", True))
    bad = {one.name for one in check(config, bench.robot, "robbie") if one.state == "bad"}
    assert bad == {f"servo {NUMBER[ELBOW]}, {ELBOW}", f"servo {NUMBER[WHEELS[0]]}, {WHEELS[0]}"}
