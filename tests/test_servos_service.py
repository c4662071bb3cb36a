"""The servo service from messages to bytes, at the ends of emulated lines, in real time."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Callable, Coroutine, Iterator
from functools import wraps
from pathlib import Path

import pytest
from wire_servos import LONG_S, MS, WHEEL, ServoBench, angle, inspected, moved

from cocoro import topics
from cocoro.errors import ConfigError, RemoteError
from cocoro.messages import EstopRequest, ServoRequest
from cocoro.robot import Robot
from cocoro.servo_units import UNITS, Protocol
from cocoro.testing import ServiceUnderTest
from services.servos.bus import PortError, RefusedWriteError, SilentError
from services.servos.cycle import STATE
from services.servos.motion import LEAD_S, REACH_RAD
from sim.wire.line import LineFault

pytestmark = [pytest.mark.zenoh, pytest.mark.alone]

ELBOW = 5
FOREVER_NS = 10**19


@pytest.fixture(params=UNITS)
def bench(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[ServoBench]:
    protocol: Protocol = request.param
    with ServoBench(tmp_path, overload_s=0.3, protocol=protocol) as bench:
        yield bench


def in_real_time(test: Callable[[ServoBench], Coroutine[None, None, None]]) -> Callable[[ServoBench], None]:
    @wraps(test)
    def run(bench: ServoBench) -> None:
        asyncio.run(asyncio.wait_for(test(bench), 60.0))

    return run


# --- the line ---------------------------------------------------------------------------------------


def test_registers_are_read_and_written_over_the_wire(bench: ServoBench) -> None:
    with bench.bus() as bus:
        assert bench.family.models[bus.ping(ELBOW) or 0] in ("RX-28", "STS3215")
        assert bus.ping(99) is None
        bus.write(ELBOW, "torque_limit", 700)
        assert bus.read(ELBOW, "torque_limit") == 700
        assert bench.get(ELBOW, "torque_limit") == 700
        with pytest.raises(RefusedWriteError, match=r"servo 5 (refuses 254 for|does not take 254)"):
            bus.keep(ELBOW, "id", 254)
        with pytest.raises(SilentError, match="servo 99 does not answer"):
            bus.read(99, "voltage")


def test_several_goals_go_in_one_packet(bench: ServoBench) -> None:
    with bench.bus() as bus:
        bus.go({4: (400, 30), 5: (500, 40)})
        assert bus.read(5, "goal_position") == 500
        assert (bench.get(4, "goal_position"), bench.get(4, "moving_speed")) == (400, 30)


def test_at_a_wrong_baud_rate_nobody_answers(bench: ServoBench) -> None:
    with bench.bus(baud=57_600, reply_s=0.02) as bus:
        assert bus.ping(ELBOW) is None


def test_a_damaged_answer_is_no_answer_and_the_next_is_read(bench: ServoBench) -> None:
    line = bench.emulator.lines["arm"]
    with bench.bus(reply_s=0.02) as bus:
        bench.call(lambda: line.disturb(LineFault("corrupted", 0.5, "to_driver", FOREVER_NS)))
        for _ in range(10):
            with pytest.raises(SilentError):
                bus.reading(ELBOW)
        assert bus.strays > 0
        bench.call(line.undisturb)
        assert bus.reading(ELBOW).position == bench.get(ELBOW, "present_position")


def test_a_port_that_is_not_there_or_goes_away_is_said(bench: ServoBench) -> None:
    with pytest.raises(PortError, match="is the adapter plugged in"):
        bench.bus("nothing")
    with bench.bus() as bus:
        with pytest.raises(PortError, match="another program has it open"):
            bench.bus()
        bench.call(bench.emulator.lines["arm"].port.unplug)
        with pytest.raises(PortError):
            bus.reading(ELBOW)


def test_an_answer_that_comes_late_is_not_taken_for_that_to_another_question(bench: ServoBench) -> None:
    line = bench.emulator.lines["arm"]
    centre = bench.get(ELBOW, "present_position")
    with bench.bus(reply_s=0.3) as bus:
        for _ in range(3):
            bench.call(lambda: line.disturb(LineFault("late", 1.0, "to_driver", FOREVER_NS, 450 * MS)))
            with pytest.raises(SilentError):
                bus.read_block(ELBOW, *bench.family.block(*STATE))
            bench.call(line.undisturb)
            assert bus.reading(ELBOW).position == centre
            assert bus.strays > 0


# --- the service ------------------------------------------------------------------------------------


@in_real_time
async def test_joints_go_where_they_are_told_and_tell_where_they_are(bench: ServoBench) -> None:
    async with moved(bench) as servos:
        servos.move("arm", elbow=0.6, shoulder=0.4)
        servos.move("hand", claw_left=-0.3)
        state = await servos.state("arm", lambda state: abs(angle(state, "elbow") - 0.6) < 2 * bench.units.count_rad)
        assert angle(state, "shoulder") == pytest.approx(0.4, abs=2 * bench.units.count_rad)
        await servos.state("hand", lambda state: abs(angle(state, "claw_left") + 0.3) < 2 * bench.units.count_rad)
        assert bench.get(ELBOW, "moving_speed") == round(1.0 / bench.units.speed_radps)


@in_real_time
async def test_torque_comes_on_without_a_snap(bench: ServoBench) -> None:
    servo, centre = bench.servo(ELBOW), bench.get(ELBOW, "present_position")
    bench.put(ELBOW, goal_position=1000)
    async with moved(bench):
        written = [(address, value) for _, address, value in bench.call(servo.acted.copy)]
        first = [address for address, _ in written]
        speed, goal, torque = (bench.at(name) for name in ("moving_speed", "goal_position", "torque_enable"))
        assert first.index(speed) < first.index(goal)  # the speed before what may make it move
        assert first.index(goal) < first.index(torque)  # the goal before the torque
        assert {value for address, value in written if address == goal} == {centre}


@in_real_time
async def test_an_arm_stops_when_no_command_comes_any_more_and_the_hand_goes_on(bench: ServoBench) -> None:
    async with moved(bench) as servos:
        servos.move("arm", elbow=2.5)
        servos.move("hand", claw_left=-1.0)
        await servos.state("arm", lambda state: angle(state, "elbow") > 0.3)
        servos.silence()
        stopped = await servos.state("arm", lambda state: state.speed_radps[state.joints.index("elbow")] == 0.0)
        assert angle(stopped, "elbow") < 2.0
        await servos.state("hand", lambda state: abs(angle(state, "claw_left") + 1.0) < 2 * bench.units.count_rad)


@in_real_time
async def test_the_emergency_stop_holds_the_arm_where_it_is(bench: ServoBench) -> None:
    async with moved(bench) as servos:
        servos.move("arm", elbow=2.5)
        await servos.state("arm", lambda state: angle(state, "elbow") > 0.3)
        reply = await servos.service.ask(topics.ESTOP.of("arm"), EstopRequest(by="test"))
        assert reply.latch == "latched"
        state = await servos.state("arm", lambda state: state.speed_radps[state.joints.index("elbow")] == 0.0)
        assert state.stopped_by == "estop"
        assert angle(state, "elbow") < 2.0
        assert all(state.torque_enabled)


@in_real_time
async def test_an_overload_is_told_and_cleared_on_purpose(bench: ServoBench) -> None:
    async with moved(bench) as servos:
        bench.call(lambda: bench.body.blocked.add(ELBOW))
        servos.move("arm", elbow=1.0)
        await servos.fault("arm", "elbow: overload; `cocoro servos clear`")
        assert bench.call(lambda: bench.servo(ELBOW).motor.limit) <= 0.2
        bench.call(bench.body.blocked.clear)
        servos.silence()
        reply = await servos.service.ask(topics.SERVOS.of("arm"), ServoRequest(action="clear"))
        assert (reply.joints, reply.text) == (("elbow",), "")
        assert bench.call(lambda: bench.servo(ELBOW).motor.limit) == 1.0
        servos.move("arm", elbow=0.5)
        await servos.state("arm", lambda state: abs(angle(state, "elbow") - 0.5) < 2 * bench.units.count_rad)


@in_real_time
async def test_a_servo_that_is_set_up_as_a_wheel_is_made_limp_and_gets_no_orders(bench: ServoBench) -> None:
    bench.put(ELBOW, torque_enable=1, moving_speed=500, **WHEEL[bench.family.protocol])
    async with inspected(bench) as servos:
        await servos.fault("arm", "elbow: servo 5 is set up as a wheel")
        servos.move("arm", elbow=1.0, shoulder=0.2)
        await servos.state("arm", lambda state: angle(state, "shoulder") > 0.15)
        assert bench.get(ELBOW, "torque_enable") == 0
        written = {address for _, address, _ in bench.call(bench.servo(ELBOW).acted.copy)}
        assert written == {bench.at("torque_enable")}
        repaired = {"dynamixel": {"high_limit": 1023}, "feetech": {"mode": 0}}
        bench.put(ELBOW, **repaired[bench.family.protocol])
        reply = await servos.service.ask(topics.SERVOS.of("arm"), ServoRequest(action="clear"))
        assert (reply.joints, reply.text) == (("elbow",), "")


@in_real_time
async def test_joints_are_relaxed_and_held_on_request(bench: ServoBench) -> None:
    async with moved(bench) as servos:
        ask = servos.service.ask
        reply = await ask(topics.SERVOS.of("arm"), ServoRequest(action="relax", joints=("elbow",)))
        assert (reply.joints, bench.get(ELBOW, "torque_enable")) == (("elbow",), 0)
        bench.put(ELBOW, goal_position=512)
        servos.move("arm", elbow=1.0, shoulder=0.2)
        await servos.state("arm", lambda state: angle(state, "shoulder") > 0.15)
        assert bench.get(ELBOW, "torque_enable") == 0  # it was not written a goal, which would have made it hold
        await ask(topics.SERVOS.of("arm"), ServoRequest(action="hold"))
        assert bench.get(ELBOW, "torque_enable") == 1
        with pytest.raises(RemoteError, match="arm has no joint 'claw_left'"):
            await ask(topics.SERVOS.of("arm"), ServoRequest(action="relax", joints=("claw_left",)))


@in_real_time
async def test_a_servo_that_falls_silent_is_named_and_the_others_keep_their_rate(bench: ServoBench) -> None:
    async with moved(bench, reply_s=0.03) as servos:
        bench.call(lambda: setattr(bench.servo(ELBOW), "mute", True))
        await servos.fault("arm", "elbow (ID 5) does not answer")
        await servos.state("arm", lambda state: "elbow" not in state.joints and len(state.joints) == 5)
        bench.call(lambda: setattr(bench.servo(ELBOW), "mute", False))
        await servos.without("arm", "does not answer")
        servos.move("arm", elbow=0.3)
        await servos.state("arm", lambda state: angle(state, "elbow") > 0.25)


@in_real_time
async def test_a_disturbed_line_is_told_and_obeyed_no_wrong_way(bench: ServoBench) -> None:
    line = bench.emulator.lines["arm"]
    async with moved(bench, reply_s=0.03) as servos:
        servos.move("arm", elbow=0.4)
        bench.call(bench.servo(ELBOW).acted.clear)
        bench.call(lambda: line.disturb(LineFault("corrupted", 0.02, "both", FOREVER_NS)))
        await servos.fault("arm", "the line is disturbed, check its cables")
        bench.call(line.undisturb)
        await servos.state("arm", lambda state: angle(state, "elbow") > 0.35)
        written, goal = bench.call(bench.servo(ELBOW).acted.copy), bench.at("goal_position")
        goals = [value for _, address, value in written if address == goal]
        assert goals
        assert bench.count("elbow", -0.06) <= min(goals) <= max(goals) <= bench.count("elbow", 0.45)


@in_real_time
async def test_a_servo_whose_power_comes_back_holds_again_where_it_is(bench: ServoBench) -> None:
    async with moved(bench) as servos:
        servos.move("arm", elbow=0.5)
        await servos.state("arm", lambda state: abs(angle(state, "elbow") - 0.5) < 2 * bench.units.count_rad)
        servos.silence()
        bench.put(ELBOW, voltage=30)
        await servos.fault("arm", "elbow (ID 5) does not answer")
        bench.put(ELBOW, voltage=120)
        bench.call(bench.servo(ELBOW).power_up)
        state = await servos.state("arm", lambda state: len(state.joints) == 6 and all(state.torque_enabled))
        assert angle(state, "elbow") == pytest.approx(0.5, abs=3 * bench.units.count_rad)
        settings = bench.family.settings(bench.robot.joints["elbow"], 1.0)
        assert {name: bench.get(ELBOW, name) for name in settings} == settings  # they were lost, too


@in_real_time
async def test_a_short_loss_of_power_is_noticed_told_and_made_good(bench: ServoBench) -> None:
    async with moved(bench) as servos:
        bench.call(lambda: bench.servo(ELBOW).power_up())
        await servos.fault("arm", "elbow lost its settings")
        await bench.until(lambda: bench.get(ELBOW, "torque_enable") and bench.get(ELBOW, "moving_speed"))


@in_real_time
async def test_a_pulled_adapter_is_a_fault_of_its_network_alone(bench: ServoBench) -> None:
    async with moved(bench) as servos:
        bench.call(bench.emulator.lines["arm"].port.unplug)
        await servos.fault("arm", "is the adapter plugged in?")
        servos.move("hand", claw_right=0.3)
        await servos.state("hand", lambda state: angle(state, "claw_right") > 0.25)
        bench.call(bench.emulator.lines["arm"].port.plug)
        await servos.healthy("arm")


@in_real_time
async def test_a_restarted_service_does_not_drop_what_the_hand_holds(bench: ServoBench) -> None:
    async with moved(bench) as servos:
        bench.call(lambda: bench.body.blocked.add(8))
        bench.tireless(8)
        servos.move("hand", claw_left=1.0)
        await servos.state("hand", lambda state: state.load[state.joints.index("claw_left")] > 0.9)
    goal = bench.get(8, "goal_position")
    async with moved(bench) as servos:
        state = await servos.state("hand", lambda state: True)
        assert state.load[state.joints.index("claw_left")] > 0.9
        assert bench.get(8, "goal_position") == pytest.approx(goal, abs=2)


def test_an_unknown_joint_in_the_configuration_is_refused() -> None:
    async def scenario() -> None:
        with pytest.raises(ConfigError, match="no joint 'elbo'"):
            async with ServiceUnderTest("services.servos.service", {"torque": {"elbo": 0.5}}, robot=Robot.load()):
                pass

    asyncio.run(asyncio.wait_for(scenario(), LONG_S))


@pytest.mark.process
def test_a_killed_service_leaves_an_arm_that_stops_by_itself(bench: ServoBench) -> None:
    script = Path(__file__).with_name("move_forever.py")
    service = subprocess.Popen(
        [sys.executable, str(script), bench.port("arm"), bench.port("hand"), bench.family.protocol]
    )
    try:
        bench.emulator.until(lambda: bench.get(ELBOW, "present_position") > bench.count("elbow", 0.45))
    finally:
        service.kill()
        service.wait()
    killed_at = bench.call(lambda: bench.get(ELBOW, "present_position"))
    bench.emulator.until(lambda: bench.get(ELBOW, "present_position") == bench.get(ELBOW, "goal_position"))
    went = bench.get(ELBOW, "present_position") - killed_at
    # Normally 0.2 s of travel; on a busy machine at most the upper bound for the point ahead of the joint.
    assert went * bench.units.count_rad < REACH_RAD + LEAD_S * 0.5 + 0.05
    assert bench.get(ELBOW, "present_position") < bench.count("elbow", 2.5)
