"""A hand with one moving jaw: the other finger is fixed, and the jaw moves a target over to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bodies import DESCRIPTION, with_one_jaw, without_line, written

from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.errors import ConfigError
from cocoro.messages import ServoState
from cocoro.robot import Robot
from services.executive.tasks import FetchTask
from services.planning.behaviours import Actuators
from services.planning.config import HandConfig, PlanningConfig
from services.planning.hand import Grip, aside_m
from sim.body import body_of_parts, pose_of

CAN_M = (0.62, -0.07, 0.065)
WIDTH_M, ROOM_M = 0.066, 0.010
NEAR_M = 0.015
"""A fixed pad near the axis, as that of the SO-101: the jaw does nearly all of the opening."""


def one_jaw(folder: Path, jaw: str = "claw_left", fixed_pad_m: float = 0.036) -> Robot:
    return Robot.load(Path(written(folder, with_one_jaw(jaw, fixed_pad_m))))


@pytest.mark.sim
@pytest.mark.parametrize(("jaw", "fixed_pad_m"), [("claw_left", 0.036), ("claw_right", NEAR_M)])
def test_it_grasps_lifts_and_holds_a_can(jaw: str, fixed_pad_m: float, tmp_path: Path) -> None:
    result = rehearse(
        RehearsalRequest(
            task=FetchTask(label="red_can"), description=written(tmp_path, with_one_jaw(jaw, fixed_pad_m)),
            width=320, height=240, frame_rate_hz=15.0,
        )
    )  # fmt: skip
    assert (result["outcome"], result["reason"]) == ("done", "")
    truth = result["truth"]
    assert truth["held"]
    assert truth["target_moved_m"] < ROOM_M + 0.01, "the jaw moves it over to the fixed finger, and nothing else does"
    assert not truth["collisions"]
    assert not truth["knocked_over"]


@pytest.mark.parametrize("jaw", ["claw_left", "claw_right"])
@pytest.mark.parametrize("fixed_pad_m", [NEAR_M, 0.036])
def test_the_fixed_finger_goes_half_a_width_and_some_room_beside_the_centre(
    jaw: str, fixed_pad_m: float, tmp_path: Path
) -> None:
    robot = one_jaw(tmp_path, jaw, fixed_pad_m)
    actuators = Actuators(robot, PlanningConfig())
    aside = aside_m(robot, WIDTH_M, ROOM_M)
    assert actuators.reachability.why_not(CAN_M, aside) == ""
    start = dict.fromkeys(robot.joints, 0.0) | actuators.reacher.upright
    around = actuators.reacher.solve(start, actuators.reachability.grasp(CAN_M, aside).around)
    assert around is not None
    (pad,) = [part for part in body_of_parts(robot).parts["wrist_roll"] if part.name == "fixed_pad"]
    place = (robot.chain("wrist_roll").pose(start | around) @ pose_of(pad))[:3, 3]
    away_m = float(np.hypot(*(place - CAN_M)[:2])) - robot.claw.pad_thickness_m / 2
    assert away_m == pytest.approx(WIDTH_M / 2 + ROOM_M, abs=0.004)
    assert abs(place[2] - CAN_M[2]) < 0.01


@pytest.mark.parametrize("fixed_pad_m", [NEAR_M, 0.036])
def test_the_pads_face_each_other_at_the_gap_that_is_described(fixed_pad_m: float, tmp_path: Path) -> None:
    robot = one_jaw(tmp_path, fixed_pad_m=fixed_pad_m)
    parts = body_of_parts(robot).parts
    at_zero = dict.fromkeys(robot.joints, 0.0)

    def place(link: str, name: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        (part,) = [part for part in parts[link] if part.name == name]
        return np.asarray((robot.chain(link).pose(at_zero) @ pose_of(part))[:3, 3])

    apart = place("claw_left", "claw_left_pad") - place("wrist_roll", "fixed_pad")
    assert np.linalg.norm(apart) == pytest.approx(robot.claw.pad_gap_m + robot.claw.pad_thickness_m, abs=0.001)


def test_both_fingers_are_what_holds(tmp_path: Path, robot: Robot) -> None:
    assert one_jaw(tmp_path).fingers == ("claw_left", "wrist_roll")
    assert robot.fingers == ("claw_left", "claw_right")
    assert aside_m(robot, WIDTH_M, ROOM_M) == 0.0


def test_one_jaw_that_is_stopped_holds_something(tmp_path: Path) -> None:
    robot, config = one_jaw(tmp_path), HandConfig()
    grip = Grip(robot, config)

    def measured(opening_rad: float, load: float) -> ServoState:
        sign = robot.claw.open_sign["claw_left"]
        return ServoState(
            joints=("claw_left",), position_rad=(sign * opening_rad,), speed_radps=(0.0,), load=(-sign * load,)
        )

    grip.close()
    for load, holding in ((0.1, False), (0.5, True)):
        for now_ns in (0, 10**9):
            grip.feel(measured(-0.06, load), now_ns)
        assert grip.holding(10**9) == holding
    grip.feel(measured(-config.close_rad, 0.5), 2 * 10**9)
    assert not grip.holding(3 * 10**9), "closed on nothing"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (without_line(with_one_jaw(), "fixed_pad_m"), "the other finger is fixed, and fixed_pad_m says where"),
        (DESCRIPTION.replace("[claw]", "[claw]\nfixed_pad_m = 0.03"), "with two joints no finger is fixed"),
        (without_line(DESCRIPTION, "open_sign").replace("[claw]", "[claw]\nopen_sign = {}"), "one joint or two, not 0"),
    ],
)
def test_a_contradiction_is_named(text: str, error: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=error):
        Robot.load(Path(written(tmp_path, text)))


def test_a_single_jaw_that_clamps_goes_on_with_what_moves_on_and_a_pair_stays(tmp_path: Path, robot: Robot) -> None:
    config = HandConfig()
    for body, follows in ((one_jaw(tmp_path), True), (robot, False)):
        grip, signs = Grip(body, config), body.claw.open_sign

        def goals(opening_rad: float, grip: Grip = grip, signs: dict[str, float] = signs) -> set[float]:
            hand = ServoState(
                joints=tuple(signs), position_rad=tuple(sign * opening_rad for sign in signs.values()),
                speed_radps=(0.0,) * len(signs), load=tuple(-0.3 * sign for sign in signs.values()),
            )  # fmt: skip
            if grip.command(None).joints == ():
                grip.clamp(hand)
            grip.feel(hand, 10**9)
            command = grip.command(None)
            return {round(signs[name] * goal, 6) for name, goal in zip(command.joints, command.goal_rad, strict=True)}

        assert goals(0.1) == {round(0.1 - config.clamp_rad, 6)}
        assert goals(0.02) == {round(0.02 - config.clamp_rad, 6) if follows else round(0.1 - config.clamp_rad, 6)}
        assert goals(0.05) == {round(0.02 - config.clamp_rad, 6) if follows else round(0.1 - config.clamp_rad, 6)}
        assert not follows or goals(-0.29) == {-config.close_rad}
        grip.open()
        assert goals(-0.29) == {config.open_rad}
