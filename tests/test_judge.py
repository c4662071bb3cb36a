"""The judge, fed with handmade truths."""

from __future__ import annotations

from collections.abc import Iterable
from math import cos, radians, sin

import msgspec
import pytest

from cocoro.messages import TrueObject, Truth
from cocoro.robot import Robot
from cocoro.units import Vec3
from sim.judge import Judge, PursuitJudge
from sim.scene import Scene, SceneObject

HZ = 30
ROBOT = Robot.load()
BOTH = ("claw_left", "claw_right")
SCENE = Scene(
    name="test",
    objects=(
        SceneObject(label="red_can", shape="cylinder", radius_m=0.033, height_m=0.12, position_m=(1.0, 0.0)),
        SceneObject(label="green_can", shape="cylinder", radius_m=0.033, height_m=0.12, position_m=(1.0, 1.0)),
        SceneObject(label="yellow_ball", shape="sphere", radius_m=0.03, position_m=(1.0, -1.0)),
        SceneObject(
            label="blue_ball",
            shape="sphere",
            radius_m=0.04,
            position_m=(2.0, 0.0, 0.5),
            path_m=((2.0, 1.0),),
            speed_mps=0.2,
        ),
    ),
)
PLACES: dict[str, Vec3] = {
    "red_can": (1.0, 0.0, 0.06),
    "green_can": (1.0, 1.0, 0.06),
    "yellow_ball": (1.0, -1.0, 0.03),
    "blue_ball": (2.0, 0.0, 0.5),
}


def truth(
    time_s: float,
    places: dict[str, Vec3] | None = None,
    touching: Iterable[str] = ("floor",),
    tilt_deg: dict[str, float] | None = None,
    collisions: tuple[str, ...] = (),
) -> Truth:
    """A truth with all objects at their places except the given ones; `touching` is the red can's, tilts are about
    x."""
    objects = []
    for label, place in (PLACES | (places or {})).items():
        half = radians((tilt_deg or {}).get(label, 0.0)) / 2
        objects.append(
            TrueObject(
                label=label,
                kind="object",
                position_m=place,
                orientation=(sin(half), 0.0, 0.0, cos(half)),
                touching=tuple(touching) if label == "red_can" else ("floor",),
            )
        )
    return Truth(
        stamp_ns=round(time_s * 1e9),
        body_m=(0.0, 0.0, 0.0),
        body_orientation=(0.0, 0.0, 0.0, 1.0),
        joints_rad={},
        objects=tuple(objects),
        collisions=collisions,
    )


def hold(judge: Judge, start_s: float, lasting_s: float, height_m: float, touching: Iterable[str] = BOTH) -> None:
    for tick in range(round(lasting_s * HZ) + 1):
        judge.feed(truth(start_s + tick / HZ, {"red_can": (0.4, -0.1, height_m + 0.06)}, touching))


def test_a_can_in_both_claws_ten_centimetres_up_for_two_seconds_is_held() -> None:
    judge = Judge(ROBOT, SCENE, "red_can")
    judge.feed(truth(0.0))
    judge.feed(truth(1.0, touching=("floor", *BOTH)))
    hold(judge, 2.0, 1.9, height_m=0.15)
    assert not judge.result().held
    hold(judge, 3.9, 0.1, height_m=0.15)
    verdict = judge.result()
    assert verdict.held
    assert verdict.lifted_m == pytest.approx(0.15)
    assert verdict.knocked_over == ()


@pytest.mark.parametrize(
    ("height_m", "touching"),
    [
        (0.09, BOTH),
        (0.15, ("claw_left",)),
        (0.15, (*BOTH, "wrist_roll")),
        (0.15, (*BOTH, "floor")),
        (0.15, ()),
    ],
)
def test_too_low_in_one_claw_or_leaning_on_something_is_not_held(height_m: float, touching: tuple[str, ...]) -> None:
    judge = Judge(ROBOT, SCENE, "red_can")
    judge.feed(truth(0.0))
    hold(judge, 1.0, 5.0, height_m, touching)
    assert not judge.result().held


def test_one_slip_starts_the_two_seconds_anew() -> None:
    judge = Judge(ROBOT, SCENE, "red_can")
    judge.feed(truth(0.0))
    hold(judge, 1.0, 5.0, height_m=0.15)
    hold(judge, 6.1, 0.0, height_m=0.15, touching=("claw_left",))
    hold(judge, 6.2, 1.5, height_m=0.15)
    assert not judge.result().held


def test_a_tilted_can_hangs_lower_than_its_centre_says() -> None:
    judge = Judge(ROBOT, SCENE, "red_can")
    judge.feed(truth(0.0))
    for tick in range(3 * HZ):
        judge.feed(truth(1.0 + tick / HZ, {"red_can": (0.4, 0.0, 0.155)}, BOTH, {"red_can": 30.0}))
    verdict = judge.result()
    # 0.06 cos 30 + 0.033 sin 30 = 0.0685 below the centre
    assert verdict.lifted_m == pytest.approx(0.155 - 0.06846, abs=1e-4)
    assert not verdict.held


def test_a_can_that_tilts_or_moves_too_far_is_knocked_over() -> None:
    judge = Judge(ROBOT, SCENE, "red_can")
    judge.feed(truth(0.0))
    judge.feed(truth(1.0, {"green_can": (1.0, 1.049, 0.06)}, tilt_deg={"green_can": 29.0}))
    assert judge.result().knocked_over == ()
    judge.feed(truth(2.0, tilt_deg={"green_can": 31.0}))
    judge.feed(truth(3.0, {"red_can": (1.04, 0.04, 0.06)}))
    judge.feed(truth(4.0))
    verdict = judge.result()
    assert set(verdict.knocked_over) == {"green_can", "red_can"}
    assert verdict.target_moved_m == pytest.approx(0.0566, abs=1e-3)


def test_what_the_hand_does_with_the_target_is_no_knocking_over() -> None:
    judge = Judge(ROBOT, SCENE, "red_can")
    judge.feed(truth(0.0))
    judge.feed(truth(1.0, {"red_can": (1.01, 0.0, 0.06)}))
    judge.feed(truth(2.0, {"red_can": (1.01, 0.0, 0.06)}, (*BOTH, "floor")))
    judge.feed(truth(3.0, {"red_can": (0.5, 0.0, 0.3)}, BOTH, {"red_can": 45.0}))
    verdict = judge.result()
    assert verdict.knocked_over == ()
    assert verdict.target_moved_m == pytest.approx(0.01)


def test_a_ball_does_not_tilt_and_what_moves_by_itself_is_not_knocked_over() -> None:
    judge = Judge(ROBOT, SCENE, "red_can")
    judge.feed(truth(0.0))
    judge.feed(truth(1.0, {"blue_ball": (2.0, 0.9, 0.5)}, tilt_deg={"yellow_ball": 90.0}))
    assert judge.result().knocked_over == ()
    judge.feed(truth(2.0, {"yellow_ball": (1.1, -1.0, 0.03)}))
    assert judge.result().knocked_over == ("yellow_ball",)


def test_collisions_are_told_once_each_in_the_order_in_which_they_came() -> None:
    judge = Judge(ROBOT, SCENE, "red_can")
    judge.feed(truth(0.0, collisions=("elbow~green_can",)))
    judge.feed(truth(1.0, collisions=("chassis~red_can", "elbow~green_can")))
    assert judge.result().collisions == ("elbow~green_can", "chassis~red_can")


def test_a_task_without_a_target_is_judged_by_the_rest() -> None:
    judge = Judge(ROBOT, SCENE)
    judge.feed(truth(0.0))
    judge.feed(truth(1.0, {"red_can": (1.2, 0.0, 0.06)}))
    verdict = judge.result()
    assert not verdict.held
    assert verdict.knocked_over == ("red_can",)


def test_a_verdict_is_json() -> None:
    judge = Judge(ROBOT, SCENE, "red_can")
    judge.feed(truth(0.0))
    assert set(msgspec.json.decode(msgspec.json.encode(judge.result()))) == {
        "lifted_m",
        "held",
        "knocked_over",
        "collisions",
        "target_moved_m",
        "target_from_start_m",
        "target_standing",
    }


def test_where_the_target_ends_is_told_from_where_the_robot_began() -> None:
    judge = Judge(ROBOT, SCENE, "red_can")
    judge.feed(truth(0.0))
    first = judge.result()
    x, y, _ = next(item.position_m for item in truth(0.0).objects if item.label == "red_can")
    assert first.target_from_start_m == pytest.approx((x**2 + y**2) ** 0.5)
    assert first.target_standing


def test_a_target_that_the_scene_has_not_is_refused() -> None:
    with pytest.raises(KeyError, match="red_can"):
        Judge(ROBOT, SCENE, "purple_can")


def test_what_the_hand_holds_at_the_start_is_not_knocked_over_when_it_is_put_down() -> None:
    judge = Judge(ROBOT, SCENE)
    judge.feed(truth(0.0, {"red_can": (0.4, -0.1, 0.2)}, touching=BOTH))
    judge.feed(truth(1.0, {"red_can": (0.5, -0.1, 0.06)}))
    assert judge.result().knocked_over == ()


def test_a_pursuit_is_judged_by_the_time_with_the_target_and_by_how_long_the_robot_stood_off_it() -> None:
    robot = Robot.load()
    judge = PursuitJudge(robot, SCENE, "red_can", distance_m=0.8, within_m=0.4)
    judge.begin()

    def feed(time_s: float, gap_m: float) -> None:
        place = (0.8 + gap_m, 0.0, 0.06)
        judge.feed(
            msgspec.structs.replace(truth(time_s, {"red_can": place}), joints_rad=dict.fromkeys(robot.joints, 0.0))
        )

    for tick in range(21):
        feed(tick / 10, 0.0)
    assert (judge.result().near_share, judge.result().stood_s) == (1.0, 0.0)
    for tick in range(21, 41):
        feed(tick / 10, 1.0)
    assert judge.result().near_share == pytest.approx(0.5, abs=0.05)
    assert judge.result().stood_s == pytest.approx(2.0, abs=0.2)
