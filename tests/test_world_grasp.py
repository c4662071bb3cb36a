"""The simulated hand holds objects by friction alone."""

from __future__ import annotations

from collections.abc import Iterator
from math import radians

import numpy as np
import pytest
from world_operator import EMPTY, LEVEL, OPEN, READY, ROBOT, Operator, can, grasp_and_lift, scene_with, the_can

from sim.judge import Judge
from sim.scene import SceneObject
from sim.world import World

pytestmark = pytest.mark.sim


@pytest.fixture
def empty() -> Iterator[World]:
    with World(ROBOT, EMPTY) as world:
        yield world


@pytest.mark.parametrize("sensors", ["ideal", "real"])
@pytest.mark.parametrize(
    ("offset_m", "pitch_deg", "mass_kg"),
    [
        ((0.0, 0.0), 0.0, 0.2),
        ((0.015, 0.015), -10.0, 0.2),
        ((-0.015, -0.015), -15.0, 0.2),
        ((0.0, 0.01), -5.0, 0.35),
    ],
)
def test_a_can_is_held_by_friction_alone(
    sensors: str, offset_m: tuple[float, float], pitch_deg: float, mass_kg: float
) -> None:
    scene = scene_with(can(0.58 + offset_m[0], -0.10 + offset_m[1], mass_kg))
    judge = Judge(ROBOT, scene, "red_can")
    with World(ROBOT, scene, seed=3, sensors=sensors) as world:  # type: ignore[arg-type]
        operator = grasp_and_lift(world, (0.58, -0.10), radians(pitch_deg), judge)
        verdict = judge.result()
        assert verdict.held, the_can(world)
        assert verdict.lifted_m > 0.15
        assert verdict.knocked_over == ()
        assert operator.seen == set()
        hand = world.servo_state("hand")
        assert hand.faults == ()
        load = dict(zip(hand.joints, hand.load, strict=True))
        assert load["claw_left"] > 0.3 < -load["claw_right"]  # each pushes inwards


def test_a_held_can_survives_a_shake_and_the_end_of_commands() -> None:
    scene = scene_with(can(0.58, -0.10))
    judge = Judge(ROBOT, scene, "red_can")
    with World(ROBOT, scene) as world:
        operator = grasp_and_lift(world, (0.58, -0.10), radians(-5.0), judge)
        hand = np.linalg.inv(world.link_pose("pad_centre"))
        before = hand @ [*the_can(world).position_m, 1.0]
        for sway in (0.25, -0.25, 0.25, 0.0):
            operator.run(0.4, arm={"arm_base": sway}, speed_radps=2.0)
        operator.run(0.5, wheels_mps=(-0.3, -0.3))
        operator.run(0.5, wheels_mps=(-0.2, 0.2))
        operator.run(3.0)
        after = np.linalg.inv(world.link_pose("pad_centre")) @ [*the_can(world).position_m, 1.0]
        assert judge.result().held
        assert np.linalg.norm(after - before) < 0.01
        operator.run(1.0, hand=OPEN)
        operator.run(0.5)
        assert the_can(world).position_m[2] < 0.12
        assert not judge.result().held


def test_a_ball_is_held_too() -> None:
    ball = SceneObject(label="yellow_ball", shape="sphere", radius_m=0.03, position_m=(0.58, -0.10), mass_kg=0.1)
    scene = scene_with(ball)
    judge = Judge(ROBOT, scene, "yellow_ball")
    with World(ROBOT, scene, seed=1, sensors="real") as world:
        operator = grasp_and_lift(world, (0.58, -0.10), 0.0, judge, height_m=0.035)
        assert judge.result().held
        assert operator.seen == set()


def test_claws_that_close_on_nothing_meet_and_that_is_no_collision(empty: World) -> None:
    operator = Operator(empty)
    operator.run(1.5, arm=READY, hand={**LEVEL, "claw_left": radians(40), "claw_right": -radians(40)})
    angles = empty.truth().joints_rad
    assert 0.0 < angles["claw_left"] < radians(25)
    assert 0.0 < -angles["claw_right"] < radians(25)
    assert operator.seen == set()
