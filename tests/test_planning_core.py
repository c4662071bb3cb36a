"""The planner's core by hand: what it does with what it is told, and with what it is not told."""

from __future__ import annotations

from collections.abc import Callable
from math import hypot
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from message_samples import data_of

from cocoro import topics
from cocoro.messages import (
    BaseCommand,
    BaseState,
    Behaviour,
    Detection,
    Detections,
    Intent,
    Message,
    Obstacles,
    PlannerStatus,
    ServoCommand,
    ServoState,
)
from cocoro.robot import Robot
from cocoro.testing import CoreUnderTest
from cocoro.topics import Topic
from services.planning.config import Config
from services.planning.core import PlanningCore

ROBOT = Robot.load()
TICK_S = 0.02
CAN_M = (1.5, 0.0, 0.06)
MOVING = (topics.BASE_COMMAND, topics.ARM_COMMAND, topics.HAND_COMMAND)


class Planner:
    """A planning core on a robot that is perfectly obedient but for its wheels, and sees a can and free floor."""

    def __init__(self, config: Config | None = None) -> None:
        self.under_test = CoreUnderTest(PlanningCore(ROBOT, config or Config()))
        self.angles = dict.fromkeys(ROBOT.joints, 0.0) | ROBOT.poses["park"]
        self.base: dict[str, Any] = {}
        self.hand_load = 0.0
        self.latch = "released"
        self.wants: Intent | None = Intent()
        self.sees: tuple[float, float, float] | None = CAN_M
        self.silent: set[str] = set()
        self.incarnation = 1
        self._count = 0

    def tick(self) -> PlannerStatus:
        """One step, 20 ms later, with everything fresh that is not silent."""
        test = self.under_test
        test.now_ns += round(TICK_S * 1e9)
        here = {"odometry_m": (0.0, 0.0), "odometry_yaw_rad": 0.0, "speed_mps": 0.0, "turn_rate_radps": 0.0}
        self._feed(topics.BASE_STATE, BaseState(**(here | self.base), latch=self.latch))  # type: ignore[arg-type]
        self._feed(topics.ARM_STATE, self._servos("arm"))
        self._feed(topics.HAND_STATE, self._servos("hand"))
        if self.wants is not None:
            wants = self.wants
            self._feed(
                topics.INTENT,
                Intent(task_id=wants.task_id, step=wants.step, behaviour=wants.behaviour, label=wants.label),
            )
        if self._count % 2 == 0:
            self._feed(topics.DETECTIONS, self._seen())
            self._feed(topics.OBSTACLES, Obstacles(free=tuple((k * 0.1, 0.2, 3.0) for k in range(-31, 32))))
        self._count += 1
        test.step()
        status = self.status
        for output in test.steps[-1]:
            if isinstance(output.message, ServoCommand):
                self.angles.update(zip(output.message.joints, output.message.goal_rad, strict=True))
        return status

    def run(self, seconds: float) -> PlannerStatus:
        for _ in range(round(seconds / TICK_S)):
            status = self.tick()
        return status

    def want(self, behaviour: Behaviour, label: str = "") -> None:
        step = self.wants.step + 1 if self.wants is not None else 1
        self.wants = Intent(task_id="task", step=step, behaviour=behaviour, label=label)

    @property
    def status(self) -> PlannerStatus:
        return self.under_test.latest(topics.PLAN)

    @property
    def wheels(self) -> BaseCommand:
        return self.under_test.latest(topics.BASE_COMMAND)

    @property
    def commanded(self) -> set[str]:
        """The topics that the last step commanded on."""
        return {output.topic.name for output in self.under_test.steps[-1]} - {topics.PLAN.name}

    def _feed(self, topic: Topic[Any], message: Message) -> None:
        if topic.name not in self.silent:
            self.under_test.feed(topic, message, incarnation=self.incarnation)

    def _servos(self, network: str) -> ServoState:
        joints = ROBOT.network_joints(network)
        loads = {claw: -sign * self.hand_load for claw, sign in ROBOT.claw.open_sign.items()}
        return ServoState(
            joints=joints,
            position_rad=tuple(self.angles[name] for name in joints),
            speed_radps=(0.0,) * len(joints),
            load=tuple(loads.get(name, 0.0) for name in joints),
            latch=self.latch,  # type: ignore[arg-type]
        )

    def _seen(self) -> Detections:
        can = Detection(label="red_can", u_px=0, v_px=0, area_px=900, box_px=(0, 0, 9, 9), position_m=self.sees)
        found = (can,) if self.sees is not None else ()
        return Detections(frame_seq=0, frame_incarnation=1, width=640, height=480, detections=found)


@pytest.fixture
def planner() -> Planner:
    planner = Planner()
    planner.run(0.2)
    return planner


def approaching(planner: Planner) -> None:
    """On the way to the can."""
    planner.want("approach", "red_can")
    planner.run(2.0)
    assert planner.wheels.left_mps > 0.1


def standing(planner: Planner) -> bool:
    """Whether the wheels are told to stand, or told nothing, which stops them."""
    return planner.wheels == BaseCommand(left_mps=0.0, right_mps=0.0) if "base/command" in planner.commanded else True


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
def test_every_behaviour_says_why_and_whose_step_it_is(planner: Planner, behaviour: Behaviour) -> None:
    planner.want(behaviour, "red_can")
    status = planner.run(0.3)
    assert planner.wants is not None
    assert (status.task_id, status.step, status.behaviour) == ("task", planner.wants.step, behaviour)
    assert status.why


# --- what stops it --------------------------------------------------------------------------------


def test_a_silent_executive_first_halts_the_wheels_and_then_ends_what_was_asked(planner: Planner) -> None:
    approaching(planner)
    planner.silent.add(topics.INTENT.name)
    planner.run(0.12)
    assert not standing(planner)
    status = planner.tick()
    assert standing(planner)
    assert status.behaviour == "approach"
    status = planner.run(0.2)
    assert (status.behaviour, status.why) == ("idle", "standing still: the executive is silent")
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
def test_beyond_its_states_age_it_commands_nothing_and_in_time_it_gives_up(planner: Planner, topic: Topic[Any]) -> None:
    approaching(planner)
    planner.silent.add(topic.name)
    planner.run(topic.max_age_s - 0.01)
    assert planner.commanded == {topic.name for topic in MOVING}
    status = planner.run(0.04)
    assert planner.commanded == set()
    assert (status.state, topic.name in status.why) == ("running", True)
    status = planner.run(1.1)
    assert (status.state, status.reason) == ("failed", "stale")
    planner.silent.clear()
    planner.tick()
    assert planner.commanded == {topic.name for topic in MOVING}


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


@pytest.mark.parametrize("joint", ["neck_tilt", "claw_left", "elbow"])
def test_a_state_that_lacks_a_joint_is_no_state(planner: Planner, joint: str) -> None:
    network = ROBOT.joints[joint].network
    names = tuple(name for name in ROBOT.network_joints(network) if name != joint)
    zeros = (0.0,) * len(names)
    topic = topics.ARM_STATE if network == "arm" else topics.HAND_STATE
    planner.silent.add(topic.name)
    planner.under_test.feed(
        topic, ServoState(joints=names, position_rad=zeros, speed_radps=zeros, load=zeros, latch="released")
    )
    status = planner.tick()
    assert planner.commanded == set()
    assert status.why == f"standing still: no angle of {joint}"


# --- a clock, a base that begin anew --------------------------------------------------------------


def test_when_the_clock_begins_anew_nothing_from_before_is_acted_on(planner: Planner) -> None:
    planner.under_test.now_ns += round(1000 * 1e9)
    approaching(planner)
    planner.under_test.now_ns = round(2e9)
    planner.incarnation = 2
    planner.silent = {topics.INTENT.name, topics.ARM_STATE.name}
    status = planner.run(0.2)
    assert planner.commanded == set(), "the arm's state is from the time before"
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


# --- behaviours -----------------------------------------------------------------------------------


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


def test_approach_to_what_was_never_seen_is_lost(planner: Planner) -> None:
    planner.want("approach", "blue_can")
    assert planner.tick().reason == "lost"
    assert standing(planner)


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
    config = Config().hand
    for _ in range(40):
        planner.angles |= stopped
        planner.hand_load = 0.5
        status = planner.tick()
    assert (status.state, status.holding) == ("done", True)
    hand = planner.under_test.latest(topics.HAND_COMMAND)
    goals = dict(zip(hand.joints, hand.goal_rad, strict=True))
    for claw, sign in ROBOT.claw.open_sign.items():
        assert sign * goals[claw] == pytest.approx(0.05 - config.clamp_rad, abs=0.01)


def test_in_lock_step_it_plans_once_a_cycle_and_keeps_the_arm_back(planner: Planner) -> None:
    core = PlanningCore(ROBOT, Config(coordination="lockstep"))
    assert core.schedule.rate_hz is None
    assert core.schedule.triggers == (topics.DETECTIONS,)
    lockstep = Planner(Config(coordination="lockstep"))
    lockstep.run(0.2)
    lockstep.want("approach", "red_can")
    lockstep.run(3.0)
    planner.want("approach", "red_can")
    planner.run(3.0)
    park = ROBOT.poses["park"]
    assert {name: lockstep.angles[name] for name in park} == pytest.approx(park, abs=0.05)
    assert planner.angles["arm_base"] < 0.5, "meanwhile the other one has unfolded"


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
    abuse: list[Callable[[], tuple[Topic[Any], Message]]], behaviour: Behaviour
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
        assert hypot(command.left_mps, command.right_mps) <= 1.42 * limit
