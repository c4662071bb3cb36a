"""The planner's core: its reactions to its inputs, and to missing ones."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from message_samples import data_of
from planner_rig import CAN_M, ROBOT, TICK_S, Planner, standing, started

from cocoro import topics
from cocoro.messages import Detection, Detections, Message, ServoState
from cocoro.topics import Topic

MOVING = (topics.BASE_COMMAND, topics.ARM_COMMAND, topics.HAND_COMMAND)


@pytest.fixture
def planner() -> Planner:
    return started()


def approaching(planner: Planner) -> None:
    """Bring the robot on its way to the can."""
    planner.want("approach", "red_can")
    planner.run(2.0)
    assert planner.wheels.ahead_mps > 0.1


def only_stands(planner: Planner) -> bool:
    """Nothing is commanded but zero to the wheels."""
    return planner.commanded == {topics.BASE_COMMAND.name} and standing(planner)


# --- idle -----------------------------------------------------------------------------------------


def test_a_planner_that_is_asked_for_nothing_holds_everything_still(planner: Planner) -> None:
    before = dict(planner.angles)
    status = planner.run(1.0)
    assert standing(planner)
    assert planner.angles == pytest.approx(before)
    assert (status.behaviour, status.why) == ("idle", "nothing is asked")


def test_it_tells_what_it_knows_whatever_it_does(planner: Planner) -> None:
    status = planner.run(1.0)
    assert [estimate.label for estimate in status.known] == ["red_can"]
    assert status.known[0].position_m == pytest.approx(CAN_M, abs=0.01)
    assert status.known[0].age_s < 0.1


@pytest.mark.parametrize("behaviour", ["park", "search", "approach", "reach", "grasp", "lift", "place", "follow"])
def test_every_behaviour_says_why_and_whose_step_it_is(planner: Planner, behaviour: str) -> None:
    planner.want(behaviour, "red_can")
    status = planner.run(0.3)
    assert planner.wants is not None
    assert (status.task_id, status.step, status.behaviour) == ("task", planner.wants.step, behaviour)
    assert status.why


# --- what stops it --------------------------------------------------------------------------------


def test_a_silent_executive_first_halts_the_wheels_and_then_ends_what_was_asked(planner: Planner) -> None:
    approaching(planner)
    planner.silent.add(topics.INTENT.name)
    planner.run(ROBOT.base.command_timeout_s - 0.01)
    assert not standing(planner)
    status = planner.tick()
    assert standing(planner)
    assert (status.behaviour, status.why) == ("approach", "standing still: nothing from the executive for 0.2 s")
    status = planner.run(0.2)
    assert (status.behaviour, status.why) == ("idle", "standing still: nothing from the executive for 0.4 s")
    assert standing(planner)


def test_an_executive_that_speaks_again_is_obeyed_again(planner: Planner) -> None:
    approaching(planner)
    planner.silent.add(topics.INTENT.name)
    planner.run(1.0)
    planner.silent.clear()
    status = planner.run(1.0)
    assert status.behaviour == "approach"
    assert not standing(planner)


@pytest.mark.parametrize(
    "topic", [topics.BASE_STATE, topics.ARM_STATE, topics.HAND_STATE], ids=lambda topic: topic.name
)
def test_beyond_its_states_age_it_only_stands_and_in_time_it_gives_up(planner: Planner, topic: Topic[Any]) -> None:
    approaching(planner)
    planner.silent.add(topic.name)
    planner.run(topic.max_age_s - 0.01)
    assert planner.commanded == {topic.name for topic in MOVING}
    status = planner.run(0.04)
    assert only_stands(planner)
    assert (status.state, topic.name in status.why) == ("running", True)
    planner.run(3.0)
    planner.silent.clear()
    assert planner.run(0.3).state == "running"
    assert not standing(planner), "it goes on"
    planner.silent.add(topic.name)
    assert planner.run(topic.max_age_s + 4.9).state == "running"
    status = planner.run(0.2)
    assert (status.state, status.reason) == ("failed", "stale")
    planner.silent.clear()
    planner.tick()
    assert planner.commanded == {topic.name for topic in MOVING}


@pytest.mark.parametrize(("silent_s", "stands"), [(1.0, True), (3.0, False)])
def test_after_a_short_silence_the_arm_goes_on_to_its_goal_and_after_a_long_one_it_stays_where_it_is(
    planner: Planner, silent_s: float, stands: bool
) -> None:
    goal_rad = planner.angles["shoulder"]
    planner.silent.add(topics.ARM_STATE.name)
    planner.run(silent_s)
    planner.angles["shoulder"] = stopped_rad = goal_rad - 0.1
    planner.silent.clear()
    planner.tick()
    assert planner.angles["shoulder"] == pytest.approx(goal_rad if stands else stopped_rad)


@pytest.mark.parametrize(
    "topic",
    [topics.INTENT, topics.DETECTIONS, topics.BASE_STATE, topics.ARM_STATE, topics.HAND_STATE],
    ids=lambda topic: topic.name,
)
def test_the_longer_somebody_is_late_the_slower_it_drives_so_that_it_could_stand_in_time(
    planner: Planner, topic: Topic[Any]
) -> None:
    approaching(planner)
    full_mps = planner.wheels.ahead_mps
    assert full_mps > 0.3
    heard_ns = planner.under_test.now_ns
    planner.silent.add(topic.name)
    base = ROBOT.base
    while not standing(planner):
        status = planner.tick()
        wheels = planner.wheels
        until_s = (planner.under_test.now_ns - heard_ns) / 1e9 + TICK_S  # it is what counts until the next step
        ramp_s = base.drive.fastest_mps(wheels) / base.wheel_acceleration_mps2
        assert until_s + ramp_s <= base.stand_within_s - base.stand_reserve_s + 1e-9 or standing(planner)
        if 0 < wheels.ahead_mps < 0.9 * full_mps:
            assert status.why.startswith("slower, for ")
    assert (planner.under_test.now_ns - heard_ns) / 1e9 <= base.command_timeout_s + 2 * TICK_S


@pytest.mark.parametrize("topic", [topics.INTENT, topics.DETECTIONS], ids=lambda topic: topic.name)
def test_a_short_silence_costs_no_more_speed_than_the_wheels_lose_in_it(planner: Planner, topic: Topic[Any]) -> None:
    approaching(planner)
    before_mps = planner.wheels.ahead_mps
    planner.silent = {topic.name}
    while not standing(planner):
        planner.tick()
    planner.silent = set()
    planner.run(0.04)
    lost_mps = before_mps - planner.wheels.ahead_mps
    # They slow down from a step before this speed's patience on, until the planner stands, and for two steps more.
    base = ROBOT.base
    slowing_s = base.command_timeout_s - (base.patience_s(before_mps) - TICK_S) + 2 * TICK_S
    assert 0.0 < lost_mps <= slowing_s * base.wheel_acceleration_mps2
    assert planner.wheels.ahead_mps > 0.05


def test_a_clock_that_is_ahead_of_ours_makes_nobody_seem_younger(planner: Planner) -> None:
    approaching(planner)
    wants = planner.wants
    assert wants is not None
    now_ns = planner.under_test.now_ns
    planner.silent.add(topics.INTENT.name)
    planner.under_test.feed(topics.INTENT, copy(wants), stamp_ns=now_ns + round(0.2 * 1e9))
    planner.tick()
    assert not standing(planner)
    planner.run(ROBOT.base.command_timeout_s + TICK_S)
    assert standing(planner)


def test_one_lost_word_costs_little_speed_and_no_stop(planner: Planner) -> None:
    approaching(planner)
    full_mps = planner.wheels.ahead_mps
    for topic in (topics.INTENT, topics.DETECTIONS, topics.BASE_STATE):
        planner.silent = {topic.name}
        planner.run(0.06)
        planner.silent = set()
        assert planner.wheels.ahead_mps > 0.9 * full_mps
        planner.run(0.2)


@pytest.mark.parametrize("latch", ["latched", "unknown"])
def test_while_the_hardware_is_stopped_it_commands_nothing(planner: Planner, latch: str) -> None:
    approaching(planner)
    planner.latch = latch
    status = planner.tick()
    assert planner.commanded == set()
    assert status.why == f"standing still: base: emergency stop {latch}"


def test_after_a_stop_the_arm_starts_from_where_it_is_found(planner: Planner) -> None:
    planner.want("approach", "red_can")
    planner.run(1.0)
    planner.latch = "latched"
    planner.tick()
    planner.angles |= {"shoulder": 1.0, "elbow": -1.0}
    planner.latch = "released"
    planner.want("idle")
    planner.run(0.5)
    assert planner.angles["shoulder"] == pytest.approx(1.0, abs=1e-6)
    assert planner.angles["elbow"] == pytest.approx(-1.0, abs=1e-6)


@pytest.mark.parametrize("asks", ["idle", "approach"])
def test_when_the_servos_began_anew_the_arm_starts_from_where_it_is_found(planner: Planner, asks: str) -> None:
    parked = dict(planner.angles)
    planner.want("approach", "red_can")
    planner.run(3.0)
    planner.want(asks, "red_can")
    assert abs(planner.angles[ROBOT.arm.azimuth] - parked[ROBOT.arm.azimuth]) > 1.0, "the arm is unfolded"
    planner.incarnation = 2  # a simulator that was started anew, or a supply that came back
    planner.angles |= parked
    planner.tick()
    moved = max(abs(planner.angles[name] - parked[name]) for name in (*ROBOT.arm.joints, ROBOT.arm.roll))
    assert moved < 2.5 * TICK_S + 1e-6, "no further than a step of the arm from where it stands"


@pytest.mark.parametrize("joint", ["neck_tilt", "claw_left", "elbow"])
def test_a_state_that_lacks_a_joint_is_no_state(planner: Planner, joint: str) -> None:
    group = ROBOT.joints[joint].group
    names = tuple(name for name, row in ROBOT.joints.items() if row.group == group and name != joint)
    zeros = (0.0,) * len(names)
    topic = topics.ARM_STATE if group == "arm" else topics.HAND_STATE
    planner.silent.add(topic.name)
    planner.under_test.feed(
        topic, ServoState(joints=names, position_rad=zeros, speed_radps=zeros, load=zeros, latch="released")
    )
    status = planner.tick()
    assert only_stands(planner)
    assert status.why == f"standing still: no angle of {joint}"


# --- a clock, a base that begin anew --------------------------------------------------------------


def test_when_the_clock_begins_anew_nothing_from_before_is_acted_on(planner: Planner) -> None:
    planner.under_test.now_ns += round(1000 * 1e9)
    approaching(planner)
    planner.under_test.now_ns = round(2e9)
    planner.incarnation = 2
    planner.silent = {topics.INTENT.name, topics.ARM_STATE.name}
    status = planner.run(0.2)
    assert only_stands(planner), "the arm's state is from the time before"
    assert status.behaviour == "idle", "and so is the intent"
    planner.silent = set()
    status = planner.run(0.5)
    assert status.behaviour == "approach"
    assert planner.commanded == {topic.name for topic in MOVING}


def test_a_restarted_base_has_another_odometry_and_everything_is_looked_for_anew(planner: Planner) -> None:
    approaching(planner)
    planner.incarnation, planner.sees = 2, None
    status = planner.tick()
    assert status.known == ()


def test_a_frames_detections_wait_for_the_odometry_of_their_time_but_not_for_ever(planner: Planner) -> None:
    planner.sees = None
    ahead = Detections(
        frame_seq=0, frame_incarnation=1, width=640, height=480, stamp_ns=planner.under_test.now_ns + round(0.03 * 1e9),
        detections=(
            Detection(label="ball", u_px=0, v_px=0, area_px=9, box_px=(0, 0, 3, 3), position_m=(1.0, 0.5, 0.03)),
        ),
    )  # fmt: skip
    planner.under_test.feed(topics.DETECTIONS, ahead)
    assert "ball" not in [estimate.label for estimate in planner.tick().known]
    assert "ball" in [estimate.label for estimate in planner.run(0.04).known]


def test_a_detection_is_placed_by_where_the_body_stood_then(planner: Planner) -> None:
    planner.sees = None
    seen_ns = planner.under_test.now_ns
    for k in range(1, 6):
        planner.base = {"odometry_m": (0.1 * k, 0.0)}
        planner.tick()
    planner.under_test.feed(
        topics.DETECTIONS,
        Detections(
            frame_seq=0, frame_incarnation=1, width=640, height=480,
            detections=(
                Detection(label="ball", u_px=0, v_px=0, area_px=9, box_px=(0, 0, 3, 3), position_m=(1.0, 0.5, 0.03)),
            ),
        ),
        stamp_ns=seen_ns,
    )  # fmt: skip
    ball = next(estimate for estimate in planner.tick().known if estimate.label == "ball")
    assert ball.odometry_position_m == pytest.approx((1.0, 0.5, 0.03))
    assert ball.position_m == pytest.approx((0.5, 0.5, 0.03))


# --- abuse ----------------------------------------------------------------------------------------

READ: tuple[Topic[Any], ...] = (
    topics.BASE_STATE,
    topics.ARM_STATE,
    topics.HAND_STATE,
    topics.DETECTIONS,
    topics.OBSTACLES,
    topics.INTENT,
)

PER_JOINT = ("position_rad", "speed_radps", "load")


def well_typed(topic: Topic[Any]) -> st.SearchStrategy[Callable[[], tuple[Topic[Any], Message]]]:
    """Any message that passes the border, whatever it says; of the robot's own joints and a known object, so that it
    is not simply passed over."""
    joints = ROBOT.network_joints(topic.name.partition("/")[0])

    def made(data: dict[str, Any]) -> Callable[[], tuple[Topic[Any], Message]]:
        if topic.type is ServoState:
            values = (data["position_rad"] or [1e6])[0], (data["speed_radps"] or [-1e9])[0], (data["load"] or [7.0])[0]
            lists = {name: [value] * len(joints) for name, value in zip(PER_JOINT, values, strict=True)}
            data = data | lists | {"joints": joints, "latch": "released"}
        if topic.type is Detections:
            data = data | {"detections": [found | {"label": "red_can"} for found in data.get("detections", ())]}
        return lambda: (topic, msgspec.msgpack.decode(msgpack.packb(data), type=topic.type))

    return data_of(topic.type).map(made)


@settings(max_examples=60, phases=[Phase.explicit, Phase.generate])
@given(
    abuse=st.lists(st.one_of(*map(well_typed, READ)), min_size=1, max_size=8),
    behaviour=st.sampled_from(["idle", "search", "approach", "reach", "grasp", "lift", "place", "park", "follow"]),
)
def test_nothing_that_passes_the_border_brings_it_down(
    abuse: list[Callable[[], tuple[Topic[Any], Message]]], behaviour: str
) -> None:
    planner = Planner()
    planner.run(0.1)
    planner.want(behaviour, "red_can")
    for make in abuse:
        topic, message = make()
        fed = planner.under_test
        fed.feed(topic, message, stamp_ns=message.stamp_ns or None, incarnation=message.incarnation)
        planner.tick()
        for output in fed.steps[-1]:
            msgspec.msgpack.decode(msgspec.msgpack.encode(output.message), type=output.topic.type)
    planner.run(0.3)
    assert planner.status.why
    limit = ROBOT.base.max_wheel_speed_mps
    for command in planner.under_test.outputs(topics.BASE_COMMAND):
        assert ROBOT.drive.fastest_mps(command) <= limit + 1e-9
