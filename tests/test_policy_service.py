"""The service that runs policies, alone in virtual time: what it proposes, what it refuses, and how often."""

from __future__ import annotations

import asyncio
import re
import sys
import threading
from pathlib import Path
from typing import Any

import onnx_file
import policy_rig
import pytest
from capture_rig import STILL, frame
from omni_robot import omni_robot
from policy_rig import CHUNK, LISTED, RATE_HZ
from spelled import action

from cocoro import topics
from cocoro.clock import RealClock
from cocoro.features import STATE, PolicyFeatures, names_of
from cocoro.joints import GROUPS
from cocoro.messages import AboutRequest, BaseState, Intent, PolicyActions, ServoState
from cocoro.policy import Observation, PolicyError
from cocoro.robot import Robot
from cocoro.testing import ServiceUnderTest, in_virtual_time, misdeclared
from services.policy.component import POLICY
from services.policy.config import PolicyServiceConfig
from services.policy.observing import Observer
from services.policy.onnx import OnnxPolicy
from services.policy.proposing import proposal

ROBOT = Robot.load()
WIDTH, HEIGHT = 16, 12


async def run(service: ServiceUnderTest, name: str, seconds: float = 1.0, step: int = 1) -> list[PolicyActions]:
    """Want a policy for a time, on a robot whose states come 50 times a second and whose pictures at 10 Hz."""
    for tick in range(round(seconds * 50)):
        service.feed(topics.INTENT, Intent(task_id="task", step=step, action=action("policy", name)))
        service.feed(topics.BASE_STATE, BaseState(odometry_m=(0.0, 0.0), **STILL))
        for topic, group in ((topics.ARM_STATE, GROUPS[0]), (topics.HAND_STATE, GROUPS[1])):
            joints = ROBOT.group_joints(group)
            still = (0.0,) * len(joints)
            service.feed(topic, ServoState(joints=joints, position_rad=still, speed_radps=still, load=still))
        if tick % 5 == 0:
            service.feed(topics.FRAME, frame(tick, WIDTH, HEIGHT))
        await service.advance(0.02)
    return service.outputs(topics.POLICY_ACTIONS)


def under_test(**settings: Any) -> ServiceUnderTest:
    return ServiceUnderTest(POLICY, {"policies": LISTED, **settings})


@in_virtual_time
async def test_it_proposes_chunks_and_speaks_as_it_declares() -> None:
    async with under_test() as service:
        made = await run(service, "ahead", 2.0)
        assert {message.state for message in made} == {"running"}
        assert {(message.task_id, message.step) for message in made} == {("task", 1)}
        assert {message.joints for message in made} == {tuple(ROBOT.joints)}
        assert {message.ahead_mps for message in made} == {(0.5,) * CHUNK}
        apart_s = (made[-1].observed_ns - made[0].observed_ns) / 1e9 / (len(made) - 1)
        assert apart_s == pytest.approx(CHUNK / 2 / RATE_HZ, abs=0.03)  # half a chunk; states come every 0.02 s
        assert misdeclared(POLICY, service.bus) == []


@in_virtual_time
async def test_it_is_silent_while_no_task_wants_a_policy() -> None:
    async with under_test() as service:
        await run(service, "fixed")
        service.feed(topics.INTENT, Intent(task_id="task", step=2, action=action("idle")))
        await service.advance(0.1)
        service.forget()
        for tick in range(20):
            service.feed(topics.FRAME, frame(tick, WIDTH, HEIGHT))
            await service.advance(0.1)
        assert service.outputs(topics.POLICY_ACTIONS) == []


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("notfinite", "policy notfinite: its action .* of row 0 is nan, no finite number"),
        ("tooshort", r"policy tooshort: its actions have the shape \(10, 3\); \(10, .*was declared"),
        ("broken", "the policy failed: ZeroDivisionError: a bug"),
        ("other", "policy other: its observation.state does not fit the robot calliope: the robot has no third_elbow"),
        ("wide", "policy wide: it looks at pictures of 1280 x 960 pixels, the robot's have 16 x 12"),
        ("aheed", "the robot has no policy 'aheed'; known are out, .*; did you mean ahead"),
        ("policy_rig:Ahead", "the robot has no policy 'policy_rig:Ahead'"),
    ],
)
@in_virtual_time
async def test_what_nobody_can_follow_is_refused_with_the_reason(name: str, reason: str) -> None:
    async with under_test() as service:
        made = await run(service, name)
        assert {message.state for message in made} == {"refused"}
        assert len(made) > 2  # a message may be lost
        assert re.match(reason, made[-1].text), made[-1].text
        later = await run(service, "fixed", step=2)
        assert later[-1].state == "running"  # it goes on with another one


def test_a_policy_that_takes_long_does_not_hold_up_its_service() -> None:
    """In real time: what is asked of the service is answered while the policy acts."""

    async def scenario() -> None:
        listed = {"slow": "test_policy_service:Blocking"}
        async with ServiceUnderTest(POLICY, {"policies": listed}, clock=RealClock()) as service:
            while not Blocking.entered.is_set():
                await run(service, "slow", 0.1)
            about = await service.ask(topics.ABOUT.of("policy"), AboutRequest(), 60.0)
            assert about.service == "policy"
            assert service.outputs(topics.POLICY_ACTIONS) == []
            Blocking.go.set()
            while not service.outputs(topics.POLICY_ACTIONS):
                await run(service, "slow", 0.1)

    try:
        asyncio.run(scenario())
    finally:
        Blocking.go.set()


class Blocking(policy_rig.Fixed):
    """Acts only when it is let."""

    entered, go = threading.Event(), threading.Event()

    def act(self, observation: Observation) -> Any:
        Blocking.entered.set()
        Blocking.go.wait()
        return super().act(observation)


@in_virtual_time
async def test_each_run_begins_anew_with_the_same_loaded_policy() -> None:
    async with under_test(policies={"looking": "test_policy_service:Small"}) as service:
        await run(service, "looking")
        await run(service, "looking", step=2)
        assert (Small.made, Small.last.resets) == (1, 2)


class Small(policy_rig.Fixed):
    made = 0
    last: Small

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot, width=WIDTH, height=HEIGHT)
        Small.made += 1
        Small.last = self


@in_virtual_time
async def test_a_rehearsal_may_name_a_file_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text("from policy_rig import Ahead\n\ndef make(robot):\n    return Ahead(robot)\n", encoding="utf-8")
    async with under_test(anything=True) as service:
        assert (await run(service, f"{path}:make"))[-1].state == "running"


# --- ONNX -----------------------------------------------------------------------------------------

DECLARED = "state = {names}\naction = {names}\nrate_hz = 10.0\n"


def declared(*names: str) -> str:
    return DECLARED.format(names=list(names))


@pytest.mark.parametrize("beside", [False, True])
@in_virtual_time
async def test_an_onnx_file_acts(tmp_path: Path, beside: bool) -> None:
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed (extra policy)")
    names = names_of(ROBOT)
    offset = [0.25 * number for number in range(len(names))]
    path = onnx_file.write(tmp_path / "plus.onnx", offset, {} if beside else {"cocoro": declared(*names)})
    if beside:
        path.with_suffix(".toml").write_text(declared(*names), encoding="utf-8")
    async with under_test(folder=str(tmp_path)) as service:
        last = (await run(service, "plus"))[-1]
    assert last.text == ""
    assert [*last.goal_rad[0], *last.ahead_mps, *last.turn_radps] == pytest.approx(offset)
    assert last.period_s == pytest.approx(0.1)


@in_virtual_time
async def test_an_onnx_file_that_does_not_fit_is_refused_with_what_differs(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed (extra policy)")
    names = names_of(ROBOT)
    swapped = [names[1], names[0], *names[2:]]
    zeros = [0.0] * len(names)
    onnx_file.write(tmp_path / "swapped.onnx", zeros, {"cocoro": declared(*swapped)})
    onnx_file.write(tmp_path / "mute.onnx", zeros, {})
    onnx_file.write(tmp_path / "short.onnx", zeros[:3], {"cocoro": declared(*names)})
    onnx_file.write(tmp_path / "strange.onnx", zeros, {"cocoro": declared(*names)}, of="pixels")
    onnx_file.write(tmp_path / "wrong.onnx", zeros, {"cocoro": declared(*names) + "chunk = 0\n"})
    (tmp_path / "damaged.onnx").write_bytes(b"no model")
    reasons = {
        "swapped": f"value 0 is {names[1]}, the robot's is {names[0]}",
        "mute": "declares no features",
        "short": f"its input observation.state has the shape [1, 3], [1, {len(names)}] was declared",
        "strange": "its input pixels is none of observation.state",
        "wrong": "chunk",
        "damaged": "damaged.onnx",
    }
    async with under_test(folder=str(tmp_path)) as service:
        for step, (name, reason) in enumerate(reasons.items()):
            last = (await run(service, name, 0.4, step))[-1]
            assert last.state == "refused"
            assert reason in last.text


def test_without_the_library_the_advice_is_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(PolicyError, match=r"pip install 'cocoro-mesh\[policy\]'"):
        OnnxPolicy(tmp_path / "any.onnx", PolicyServiceConfig())


def test_features_that_differ_are_named() -> None:
    names = tuple(names_of(ROBOT))
    lacking = PolicyFeatures(state=names[2:], action=names, rate_hz=10.0)
    assert lacking.differs(ROBOT).endswith(f"{names[0]}, {names[1]} are missing")
    assert PolicyFeatures(state=names, action=names, rate_hz=10.0).differs(ROBOT) == ""


def test_a_base_that_can_move_aside_is_seen_and_wanted_to_move_aside() -> None:
    robot = omni_robot()
    names = tuple(names_of(robot))
    features = PolicyFeatures(state=names, action=names, rate_hz=10.0)
    observer, found = Observer(robot, features, 0.05), None
    moving = {"speed_mps": 0.1, "aside_mps": 0.2, "turn_rate_radps": 0.3}
    states: list[tuple[topics.Topic[Any], Any]] = [
        (topics.BASE_STATE, BaseState(odometry_m=(0.0, 0.0), stamp_ns=10**9, **{**STILL, **moving}))
    ]
    for topic, group in ((topics.HAND_STATE, GROUPS[1]), (topics.ARM_STATE, GROUPS[0])):
        joints = robot.group_joints(group)
        still = (0.0,) * len(joints)
        state = ServoState(joints=joints, position_rad=still, speed_radps=still, load=still, stamp_ns=10**9)
        states.append((topic, state))
    for topic, state in states:
        found = observer.take(topic, state, 10**9)
    assert found is not None
    row = found.content[STATE].astype(float)
    assert row[-3:].tolist() == pytest.approx([0.1, 0.2, 0.3])
    row[-3:] = 0.4, 0.5, 0.6
    made = proposal(row, found, features, robot, "task", 1)
    assert (made.ahead_mps, made.aside_mps, made.turn_radps) == ((0.4,), (0.5,), (0.6,))
