"""Calibrations by LeRobot: read, refused, and fitted to the joints of a description."""

from __future__ import annotations

import json
from math import degrees, radians
from typing import Any

import msgspec
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from one_line import LINE, WHEELS, its, one_line, one_line_data

from cocoro.errors import ConfigError
from cocoro.joints import Joint
from cocoro.robot import Robot
from services.servos.lerobot import LAST, OFFSET_SIGN, Calibration, Motor, calibration, read
from services.servos.tools import MARGIN_DEG

ROBOT = one_line()
JOINTS = ROBOT.joints
ELBOW = JOINTS[its("elbow")]
COMMANDED = [name for name, joint in JOINTS.items() if joint.group is not None]
COUNT_DEG = degrees(ELBOW.units.count_rad)


def row(number: int, low: int = 1000, high: int = 3000, offset: int = 12, mode: int = 0) -> dict[str, Any]:
    return {"id": number, "drive_mode": mode, "homing_offset": offset, "range_min": low, "range_max": high}


def motors(**rows: dict[str, Any]) -> dict[str, Motor]:
    return read(json.dumps(rows).encode(), "file")


def fitted(nominal: dict[str, Joint] | None = None, reverse: tuple[str, ...] = (), **rows: dict[str, Any]) -> Joint:
    """The only joint that these motors calibrate."""
    (one,) = calibration(motors(**rows), JOINTS.values(), nominal or JOINTS, reverse=reverse).joints
    return one.joint


# --- reading ----------------------------------------------------------------------------------------


def test_a_file_is_read_by_motors_and_fields_of_later_versions_are_not() -> None:
    found = motors(one=row(1, offset=-2047), two={**row(2, 0, 4095), "model": "sts3215"})
    assert found["one"] == Motor(1, 0, -2047, 1000, 3000)
    assert (found["one"].whole_turn, found["two"].whole_turn) == (False, True)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"", "file is no JSON: "),
        (b"{", "file is no JSON: "),
        (b"\xff\xfe", "file is no JSON: "),
        (b"[" * 100_000, "file is no JSON: "),
        (b'{"one": {}, "one": {}}', "file is no JSON: 'one' is there twice"),
        (b"[]", "file is no calibration by LeRobot"),
        (b"{}", "file is no calibration by LeRobot"),
        (b'{"name": "robbie"}', "file is no calibration by LeRobot"),
        (
            b'{"motor_names": ["one"], "calib_mode": ["DEGREE"], "homing_offset": [1]}',
            "from before LeRobot's redesign",
        ),
        (b'{"one": {"id": 1}}', "file, 'one': Object missing required field `drive_mode`"),
    ],
)
def test_what_is_no_calibration_is_refused(text: bytes, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read(text, "file")
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("id", "1", "id: Expected `int`, got `str`"),
        ("id", True, "id: Expected `int`, got `bool`"),
        ("id", 254, "id: Expected `int` <= 253"),
        ("drive_mode", 2, "drive_mode: Invalid enum value 2"),
        ("homing_offset", 2048, "homing_offset: Expected `int` <= 2047"),
        ("homing_offset", None, "homing_offset: Expected `int`, got `null`"),
        ("range_min", -1, "range_min: Expected `int` >= 0"),
        ("range_min", 3000, "range_min must be below range_max, not 3000 and 3000"),
        ("range_max", 4096, "range_max: Expected `int` <= 4095"),
        ("range_max", 1.5, "range_max: Expected `int`, got `float`"),
    ],
)
def test_a_value_that_no_servo_has_is_refused_with_its_motor_and_field(field: str, value: object, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        motors(one={**row(1), field: value})
    assert f"file, 'one': {says}" in str(caught.value)


def test_two_motors_with_one_id_are_refused() -> None:
    with pytest.raises(ConfigError, match="file: 'one' and 'two' both have the ID 3"):
        motors(one=row(3), two=row(3))


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(["id", "range_min", "a"]), inner),
    max_leaves=10,
)


@given(st.binary() | json_values.map(lambda value: json.dumps(value).encode()))
def test_nothing_but_a_calibration_is_read_and_nothing_else_is_raised(text: bytes) -> None:
    with pytest.raises(ConfigError):
        read(text, "file")


# --- fitting to a description ------------------------------------------------------------------------

counts = st.integers(0, LAST)


@given(counts, counts, st.sampled_from([0, 1]), st.sampled_from([-1, 1]), st.booleans())
def test_the_ends_of_the_range_are_the_limits_and_its_middle_is_theirs(
    low: int, high: int, mode: int, direction: int, reverse: bool
) -> None:
    assume((high - low) * COUNT_DEG >= 10.0 and (low, high) != (0, LAST))
    nominal = msgspec.structs.replace(ELBOW, direction=direction, limits_deg=(-10.0, 100.0))
    joint = fitted({ELBOW.name: nominal}, (ELBOW.name,) if reverse else (), m=row(ELBOW.id, low, high, mode=mode))
    assert joint.direction == direction * (-1) ** (mode + reverse)
    assert degrees(joint.to_angle((low + high) / 2)) == pytest.approx(45.0, abs=0.01)
    ends = sorted(degrees(joint.to_angle(count)) for count in (low, high))
    assert joint.limits_deg == pytest.approx((ends[0] + MARGIN_DEG, ends[1] - MARGIN_DEG), abs=0.1)
    for limit in joint.limits_deg:
        assert low < joint.to_count(radians(limit)) < high


def test_a_second_import_makes_the_same_values() -> None:
    first = fitted(m=row(ELBOW.id, mode=1))
    joints = {**JOINTS, ELBOW.name: first}  # the measured file has them now
    (again,) = calibration(motors(m=row(ELBOW.id, mode=1)), joints.values(), JOINTS).joints
    assert again.joint == first


def test_the_zero_is_as_doubtful_as_the_range_differs_from_the_descriptions_limits() -> None:
    low, high = ELBOW.limits_deg
    width = round((high - low + 30.0) / COUNT_DEG)
    (one,) = calibration(motors(m=row(ELBOW.id, 100, 100 + width)), JOINTS.values(), JOINTS).joints
    assert one.doubt_deg == pytest.approx(15.0, abs=0.1)


def test_a_joint_that_turns_all_the_way_round_keeps_the_descriptions_limits() -> None:
    wide = msgspec.structs.replace(ELBOW, limits_deg=(-160.0, 160.0))
    (one,) = calibration(motors(m=row(ELBOW.id, 0, LAST)), JOINTS.values(), {ELBOW.name: wide}).joints
    assert one.values == {"direction": ELBOW.direction, "centre_count": 2047.5}
    assert one.doubt_deg == 0.0


def found(**rows: dict[str, Any]) -> Calibration:
    return calibration(motors(**rows), JOINTS.values(), JOINTS)


def test_what_calibrates_no_joint_is_left_out_with_the_reason() -> None:
    wheel = JOINTS[WHEELS[0]].id
    got = found(a=row(ELBOW.id), b=row(wheel, 0, LAST), c=row(99), d=row(4, 0, LAST), e=row(3, 2000, 2050))
    assert [one.joint.name for one in got.joints] == [ELBOW.name]
    wheels, nobody, passed, hardly = got.left_out
    assert wheels == f"'b', {WHEELS[0]}: a wheel, which has neither zero nor limits"
    assert nobody == f"'c': no joint on line {LINE} has the ID 99"
    assert "its range is all of the servo's, so it passed from 4095 to 0 or was not measured" in passed
    assert "it was turned by 4.4 degrees only" in hardly
    assert got.missing == tuple(name for name in COMMANDED if name != ELBOW.name)


@pytest.mark.parametrize("prefix", ["", "arm_"])
def test_a_motor_with_a_joints_name_and_another_id_is_refused(prefix: str) -> None:
    name = f"{prefix}{ELBOW.name}"
    assert found(**{name: row(ELBOW.id)}).joints[0].joint.name == ELBOW.name
    with pytest.raises(ConfigError, match=f"has {ELBOW.id}, where the ID 4 is that of {its('shoulder')}"):
        found(**{name: row(4)})
    with pytest.raises(ConfigError, match="so it is the file of another robot"):
        found(**{name: row(99)})


def test_only_lines_of_feetech_servos_count_and_an_id_on_two_of_them_needs_a_choice() -> None:
    dynamixels = Robot.load()
    with pytest.raises(ConfigError, match="no joint of the robot description is on a line of Feetech servos"):
        calibration(motors(m=row(5)), dynamixels.joints.values(), dynamixels.joints)
    data = one_line_data()
    data["network"]["base"] = data["network"][LINE]
    for one in data["joint"]:
        if one["name"] in WHEELS:
            one.update(network="base", id=one["id"] - 6)
    robot = Robot.from_data(data)
    with pytest.raises(ConfigError, match=f"ID 5 .* on {LINE} and .* on base: choose one with --line"):
        calibration(motors(m=row(5)), robot.joints.values(), robot.joints)
    (one,) = calibration(motors(m=row(5)), robot.joints.values(), robot.joints, LINE).joints
    assert one.joint.name == ELBOW.name


def test_a_joint_to_reverse_must_be_calibrated() -> None:
    with pytest.raises(ConfigError, match=f"there is no calibrated joint 'elbo' to reverse; known are {ELBOW.name}"):
        calibration(motors(m=row(ELBOW.id)), JOINTS.values(), JOINTS, reverse=["elbo"])


@given(st.integers(-2047, 2047), st.integers(-2047, 2047))
def test_a_servos_offset_is_a_sign_and_a_magnitude(file: int, servo: int) -> None:
    (one,) = found(m=row(ELBOW.id, offset=file)).joints
    register = abs(servo) | (OFFSET_SIGN if servo < 0 else 0)
    assert one.differs_by(register) == servo - file
