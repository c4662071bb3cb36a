"""The wheels of a LeKiwi on its servo line, in virtual time: commands to bytes, bytes to odometry, faults to a stop."""

from __future__ import annotations

from math import hypot

import pytest
from wheels_rig import FAMILY, MS, WheelsRig, lekiwi

from cocoro.robot import Robot

STAND_S = 0.3
FAST_MPS = 0.2


@pytest.fixture
def rig() -> WheelsRig:
    return WheelsRig().release()


def driving(rig: WheelsRig, ahead_mps: float = FAST_MPS) -> WheelsRig:
    rig.drive(ahead_mps)
    rig.run(0.5)
    assert rig.core.stopped_by(rig.now_ns) == ""
    assert rig.states[-1].speed_mps == pytest.approx(ahead_mps, rel=0.08)
    return rig


def faults(rig: WheelsRig) -> str:
    return "; ".join(rig.core.faults(rig.now_ns))


@pytest.mark.parametrize(
    ("ahead", "turn", "aside"), [(0.15, 0.0, 0.0), (0.0, 0.0, 0.12), (0.0, 0.8, 0.0), (-0.08, 0.4, -0.05)]
)
def test_it_moves_as_commanded_and_knows_how_far(rig: WheelsRig, ahead: float, turn: float, aside: float) -> None:
    before = {name: servo.shaft for name, servo in rig.wheels.items()}
    rig.drive(ahead, turn, aside)
    rig.run(2.0)
    state = rig.states[-1]
    assert (state.speed_mps, state.turn_rate_radps, state.aside_mps) == pytest.approx((ahead, turn, aside), abs=0.035)
    rig.drive()
    rig.run(0.6)
    state = rig.states[-1]
    assert state.standing
    turns = [(servo.shaft - before[name]) * FAMILY.units.count_rad for name, servo in rig.wheels.items()]
    rolled_m = [turn_rad * wheel.radius_m for turn_rad, wheel in zip(turns, rig.robot.base.wheel, strict=True)]
    way_m, turned_rad, across_m = rig.robot.drive.twist(rolled_m)
    assert state.odometry_yaw_rad == pytest.approx(turned_rad, abs=0.002)
    if not turn:
        assert state.odometry_m == pytest.approx((way_m, across_m), abs=0.0005)
        assert hypot(*state.odometry_m) > 0.2


def test_a_position_runs_on_from_turn_to_turn(rig: WheelsRig) -> None:
    rig.drive(turn_radps=1.5)
    rig.run(6.0)
    assert max(abs(servo.shaft) for servo in rig.wheels.values()) > 2 * 4096
    assert rig.states[-1].odometry_yaw_rad == pytest.approx(1.5 * 6.0, rel=0.06)


def test_a_servo_that_is_mounted_the_other_way_round_turns_the_other_way() -> None:
    data = lekiwi().to_data()
    data["base"]["wheel"][0]["servo"]["direction"] = -1
    rig = WheelsRig(robot=Robot.from_data(data)).release()
    rig.drive(turn_radps=1.0)
    rig.run(1.0)
    assert [servo.motor.endless > 0 for servo in rig.wheels.values()] == [False, True, True]  # type: ignore[operator]
    assert rig.states[-1].turn_rate_radps == pytest.approx(1.0, rel=0.05)
    assert rig.states[-1].odometry_yaw_rad > 0.7


def test_the_ramp_keeps_the_direction_of_the_motion(rig: WheelsRig) -> None:
    rig.drive(0.1, aside_mps=0.1)
    rig.run(0.12)
    going = [state for state in rig.states if state.speed_mps > 0.03]
    assert going, "it is still speeding up"
    for state in going:
        assert state.aside_mps == pytest.approx(state.speed_mps, abs=0.02)


def test_a_servo_that_is_no_wheel_never_turns(rig: WheelsRig) -> None:
    other = WheelsRig()
    other.wheels["left"].put(33, 0)
    other.core.set_latch("released")
    other.drive(0.1)
    other.run(1.0)
    assert other.stood_after(0) == 0.0
    assert "wheel left: servo 7 is not set up as a wheel: `cocoro servos set-wheel 7`; `cocoro base recover`" in faults(
        other
    )
    other.wheels["left"].put(33, 1)
    other.core.recover()
    other.run(0.6)
    assert other.core.ready


# --- what stops it --------------------------------------------------------------------------------


def test_it_stays_still_until_the_stops_state_is_known() -> None:
    rig = WheelsRig()
    rig.drive(0.1)
    rig.run(1.0)
    assert rig.states[-1].stopped_by == "latch unknown"
    assert rig.stood_after(0) == 0.0


@pytest.mark.parametrize("ahead_mps", [0.05, 0.12, 0.23])
def test_silence_of_commands_stops_it_in_time(rig: WheelsRig, ahead_mps: float) -> None:
    driving(rig, ahead_mps)
    since_ns = rig._commanded_ns
    rig.wanted = None
    rig.run(0.6)
    assert 0.0 < rig.stood_after(since_ns) <= STAND_S
    assert rig.states[-1].stopped_by == "no command"


def test_the_stop_path_stops_it_without_the_event_loop(rig: WheelsRig) -> None:
    driving(rig)
    since_ns = rig.now_ns
    rig.orders.halt()
    rig.run(0.6)
    assert rig.stood_after(since_ns) < 0.2
    rig.core.set_latch("latched")
    rig.order()
    rig.orders.go_on()
    rig.run(0.2)
    assert rig.states[-1].stopped_by == "estop"
    assert rig.stood_after(since_ns) < 0.2


def test_an_order_that_the_event_loop_does_not_renew_expires(rig: WheelsRig) -> None:
    driving(rig)
    since_ns = rig.now_ns
    rig.take = lambda result: None  # type: ignore[method-assign]
    rig.run(0.8)
    assert rig.stood_after(since_ns) <= STAND_S


def test_without_its_guard_it_does_not_turn(rig: WheelsRig) -> None:
    driving(rig)
    since_ns = rig.now_ns
    rig.orders.guarded(0)
    rig.guarded, rig.core.guard_fault = False, "the guard of the port died"
    rig.run(0.6)
    assert rig.stood_after(since_ns) < 0.2
    assert rig.states[-1].stopped_by == "link"
    assert "guard" in faults(rig)


def cut(rig: WheelsRig) -> None:
    """Pull the plug of a wheel: it has power and data."""
    rig.wheels["back"].put(62, 0)


def deafen(rig: WheelsRig) -> None:
    """Its answers get lost; it hears all the same."""
    rig.wheels["back"].put(8, 0)


@pytest.mark.parametrize("spoil", [cut, deafen])
@pytest.mark.parametrize("ahead_mps", [0.1, 0.199])
def test_a_wheel_that_does_not_answer_stops_all(rig: WheelsRig, spoil: object, ahead_mps: float) -> None:
    rig.drive(turn_radps=ahead_mps / 0.125)
    rig.run(0.5)
    since_ns = rig.now_ns
    spoil(rig)  # type: ignore[operator]
    if spoil is deafen:
        rig.bus_of_servos.by_number(8).LEVELS = {1: 1, 2: 1, 3: 1}  # type: ignore[misc]
    rig.run(1.0)
    assert rig.stood_after(since_ns) <= STAND_S
    assert "wheel back (ID 8) does not answer" in faults(rig)
    assert rig.core.stopped_by(rig.now_ns) == "link"
    assert rig.core.state(rig.now_ns) is None


def test_a_lost_packet_stops_nothing(rig: WheelsRig) -> None:
    driving(rig)
    seen = len(rig.trace)
    rig.wheels["left"].mute = True
    rig.run(0.024)
    rig.wheels["left"].mute = False
    rig.run(0.5)
    assert min(max(abs(mps) for mps in speeds) for _, speeds in rig.trace[seen:]) > 0.8 * FAST_MPS * 0.86
    assert rig.core.stopped_by(rig.now_ns) == ""


def test_a_wheel_that_is_held_up_stops_all_until_nothing_is_asked(rig: WheelsRig) -> None:
    driving(rig)
    since_ns = rig.now_ns
    rig.plant.blocked.add(7)
    rig.run(1.5)
    assert rig.stood_after(since_ns) <= STAND_S
    assert "wheel left is held up" in faults(rig)
    assert (rig.states[-1].stopped_by, rig.states[-1].overcurrent) == ("overcurrent", True)
    rig.plant.blocked.clear()
    rig.run(0.5)
    assert rig.stood_after(since_ns) <= STAND_S, "it is still asked to turn"
    rig.drive()
    rig.run(1.3)
    driving(rig)
    assert faults(rig) == ""


@pytest.mark.parametrize(
    ("error", "says", "by"),
    [
        (32, "wheel right: overload", "overcurrent"),
        (4, "wheel right: overheating", "link"),
        (8, "current", "overcurrent"),
    ],
)
def test_a_servo_that_shuts_down_stops_all_and_is_recovered(rig: WheelsRig, error: int, says: str, by: str) -> None:
    driving(rig)
    since_ns = rig.now_ns
    rig.wheels["right"].trip(error)
    rig.run(0.5)
    assert rig.stood_after(since_ns) <= STAND_S
    assert f"{says}; `cocoro base recover`" in faults(rig)
    assert rig.states[-1].stopped_by == by
    rig.drive()
    rig.core.recover()
    rig.run(0.5)
    driving(rig)


def test_a_hot_wheel_and_a_weak_supply_are_told(rig: WheelsRig) -> None:
    rig.wheels["left"].put(63, 65)
    for servo in rig.wheels.values():
        servo.put(62, 39)
    rig.run(0.1)
    assert "wheel left is hot: 65 C" in faults(rig)
    assert "wheel back has a bad voltage: 3.9 V" in faults(rig)
    assert rig.states[-1].battery_v == pytest.approx(3.9)


def test_a_wheel_whose_power_failed_for_a_moment_gets_its_settings_back(rig: WheelsRig) -> None:
    driving(rig)
    rig.wheels["left"].power_up()
    rig.wheels["left"].put(33, 1)
    rig.run(2.0)
    assert "wheel left lost its settings a moment ago" in faults(rig)
    rig.drive()
    rig.run(1.5)
    driving(rig)


@pytest.mark.parametrize("way", ["to_device", "to_driver"])
def test_damaged_packets_neither_turn_wheels_nor_spoil_the_odometry(way: str) -> None:
    rig = WheelsRig(seed=3).release()
    driving(rig, 0.15)
    rig.disturb("corrupted", 0.03, way)  # type: ignore[arg-type]
    rig.run(4.0)
    top = max(abs(mps) for _, speeds in rig.trace for mps in speeds)
    assert top <= rig.robot.base.max_wheel_speed_mps * 1.001
    assert "the line is disturbed" in faults(rig)
    since_ns = rig.now_ns
    rig.wanted = None
    rig.run(0.8)
    assert rig.stood_after(since_ns) <= STAND_S
    for one in rig._ways:
        one.clear()
    rig.run(0.5)
    shafts = [servo.shaft - 2048 for servo in rig.wheels.values()]
    rolled_m = [count * FAMILY.units.count_rad * 0.05 for count in shafts]
    assert rig.states[-1].odometry_m[0] == pytest.approx(rig.robot.drive.twist(rolled_m).ahead, abs=0.01)


# --- the guard ------------------------------------------------------------------------------------


@pytest.mark.parametrize("ahead_mps", [0.05, 0.2, 0.23])
def test_the_guard_stops_wheels_of_a_service_that_hangs(rig: WheelsRig, ahead_mps: float) -> None:
    driving(rig, ahead_mps)
    since_ns = rig.now_ns
    rig.alive = False
    rig.run(1.0)
    assert 0.0 < rig.stood_after(since_ns) <= STAND_S
    rig.alive = True
    rig.run(0.6)
    assert rig.states[-1].speed_mps == pytest.approx(ahead_mps, rel=0.1), "it undoes that when it goes on"


def test_the_guard_stops_wheels_of_a_service_that_died_and_makes_them_limp(rig: WheelsRig) -> None:
    driving(rig)
    since_ns = rig.now_ns
    rig.alive = False
    rig.guard.end(rig.now_ns)
    rig.run(0.3)
    assert rig.stood_after(since_ns) < 0.2
    assert [servo.get(40) for servo in rig.wheels.values()] == [1, 1, 1]
    rig.run(0.3)
    assert [servo.get(40) for servo in rig.wheels.values()] == [0, 0, 0]
    assert rig.guard.ended(rig.now_ns)


def test_the_guard_repeats_its_stop_on_a_bad_line(rig: WheelsRig) -> None:
    driving(rig)
    rig.disturb("corrupted", 0.05, "to_device")
    since_ns = rig.now_ns
    rig.alive = False
    rig.guard.end(rig.now_ns)
    rig.run(0.5)
    assert rig.stood_after(since_ns) <= STAND_S


def test_the_guard_obeys_a_stop_at_its_own_address_until_it_is_reset(rig: WheelsRig) -> None:
    driving(rig)
    since_ns = rig.now_ns
    rig.alive = False  # as a service that a signal has stopped
    rig.guard.stop()
    rig.run(0.3)
    assert rig.stood_after(since_ns) < 0.15
    rig.alive = True  # it goes on, and knows of no stop
    written = rig.guard.stops
    rig.run(0.05)
    assert rig.guard.poll(rig.now_ns + 20 * MS) or written == 1
    rig.guard.reset(1)
    rig.run(0.6)
    assert rig.states[-1].speed_mps == pytest.approx(FAST_MPS, rel=0.1)


def test_the_guard_of_a_standing_base_leaves_the_line_alone() -> None:
    rig = WheelsRig().release()
    rig.run(1.0)
    assert rig.guard.poll(rig.now_ns + 10_000 * MS) == b""


def test_who_opens_the_line_first_stops_what_turns() -> None:
    rig = WheelsRig()
    for servo in rig.wheels.values():
        servo.put(40, 1)
        servo.put(46, 1000)
    rig.run(0.1)
    rig.cycle.begin(rig.bus, rig.now_ns / 1e9)
    since_ns = rig.now_ns
    rig.run(0.5)
    assert rig.stood_after(since_ns) < 0.1
