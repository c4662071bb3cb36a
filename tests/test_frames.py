"""Spherical coordinates and planar poses."""

from math import pi

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cocoro.frames import Pose2, Spherical, to_cartesian, to_spherical, wrap_rad

metres = st.floats(-5, 5)
angles = st.floats(-10, 10)
poses = st.builds(Pose2, metres, metres, angles)


def test_azimuth_is_positive_to_the_left_and_elevation_upwards() -> None:
    assert to_spherical((0.0, 2.0, 0.0)) == pytest.approx((2.0, pi / 2, 0.0))
    assert to_spherical((1.0, 0.0, 1.0)) == pytest.approx((2**0.5, 0.0, pi / 4))
    assert to_spherical((0.0, -1.0, -1.0)) == pytest.approx((2**0.5, -pi / 2, -pi / 4))


def test_the_origin_has_no_direction_and_no_error() -> None:
    assert to_spherical((0.0, 0.0, 0.0)) == Spherical(0.0, 0.0, 0.0)


@settings(deadline=None)
@given(st.tuples(metres, metres, metres))
def test_spherical_and_back_is_the_same_point(point: tuple[float, float, float]) -> None:
    assert to_cartesian(to_spherical(point)) == pytest.approx(point, abs=1e-9)


def test_a_point_ahead_of_a_body_turned_left_lies_to_the_left_in_the_odometry_frame() -> None:
    assert Pose2(1.0, 2.0, pi / 2).apply((3.0, 0.0, 0.5)) == pytest.approx((1.0, 5.0, 0.5))


def test_a_velocity_turns_but_does_not_move() -> None:
    assert Pose2(1.0, 2.0, pi / 2).rotate((3.0, 0.0, 0.5)) == pytest.approx((0.0, 3.0, 0.5))


@settings(deadline=None)
@given(poses, poses, st.tuples(metres, metres, metres))
def test_a_composed_pose_does_what_its_parts_do_in_turn(a: Pose2, b: Pose2, point: tuple[float, float, float]) -> None:
    assert a.compose(b).apply(point) == pytest.approx(a.apply(b.apply(point)), abs=1e-9)


@settings(deadline=None)
@given(poses)
def test_a_pose_and_its_inverse_cancel(pose: Pose2) -> None:
    assert pose.compose(pose.inverse()) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert pose.inverse().compose(pose) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_what_was_seen_earlier_is_carried_to_the_body_of_now() -> None:
    earlier, later = Pose2(0.0, 0.0, 0.0), Pose2(1.0, 0.0, pi / 2)
    now_from_then = later.inverse().compose(earlier)
    assert now_from_then.apply((1.0, 1.0, 0.1)) == pytest.approx((1.0, 0.0, 0.1))


def test_many_turns_stay_many_turns_until_they_are_wrapped() -> None:
    total = Pose2()
    for _ in range(8):
        total = total.compose(Pose2(0.0, 0.0, pi / 2))
    assert total.yaw_rad == pytest.approx(4 * pi)
    assert wrap_rad(total.yaw_rad) == pytest.approx(0.0)


@settings(deadline=None)
@given(angles)
def test_a_wrapped_angle_is_the_same_direction_within_half_a_turn(angle: float) -> None:
    wrapped = wrap_rad(angle)
    assert -pi < wrapped <= pi
    assert (angle - wrapped) / (2 * pi) == pytest.approx(round((angle - wrapped) / (2 * pi)), abs=1e-9)


def test_half_a_turn_wraps_to_plus_pi() -> None:
    assert wrap_rad(-pi) == pi
    assert wrap_rad(3 * pi) == pytest.approx(pi)
