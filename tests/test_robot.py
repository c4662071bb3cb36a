"""The robot's description, and the errors that a file of one's own can have."""

from __future__ import annotations

from copy import deepcopy
from importlib import resources
from math import radians, tan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cocoro.errors import ConfigError
from cocoro.learning.handmap import fingerprint_of
from cocoro.robot import Camera, Robot
from cocoro.servo_units import UNITS

ROBOT = Robot.load()
COUNT_RAD = UNITS["dynamixel"].count_rad
TEXT = resources.files("cocoro").joinpath("calliope.toml").read_text()


def test_it_has_the_papers_eleven_degrees_of_freedom() -> None:
    assert ROBOT.group_joints("arm") == ("neck_pan", "neck_tilt", "arm_base", "shoulder", "elbow", "wrist_pitch")
    assert ROBOT.group_joints("hand") == ("wrist_roll", "claw_left", "claw_right")
    assert len(ROBOT.joints) + 2 == 11


def test_the_park_pose_is_within_the_limits() -> None:
    for name, angle_rad in ROBOT.poses["park"].items():
        low, high = ROBOT.joints[name].limits_rad
        assert low <= angle_rad <= high


# --- servos ---------------------------------------------------------------------------------------

joints = pytest.mark.parametrize("name", ROBOT.joints)


@joints
def test_the_middle_of_a_servos_range_is_zero_and_its_ends_are_150_degrees(name: str) -> None:
    joint = ROBOT.joints[name]
    assert joint.to_angle((1024 - 1) / 2) == 0.0
    assert [joint.to_angle(0), joint.to_angle(1023)] == pytest.approx([-radians(150), radians(150)])


@joints
@given(count=st.integers(0, 1023))
def test_a_servo_position_comes_back_as_it_was(name: str, count: int) -> None:
    joint = ROBOT.joints[name]
    assert joint.to_count(joint.to_angle(count)) == count


@joints
@given(angle_rad=st.floats(-10, 10))
def test_a_goal_is_met_to_half_a_count_or_to_the_range_s_end(name: str, angle_rad: float) -> None:
    joint = ROBOT.joints[name]
    goal_rad = min(max(angle_rad, -radians(150)), radians(150))
    assert abs(joint.to_angle(joint.to_count(angle_rad)) - goal_rad) <= COUNT_RAD / 2 + 1e-12


def test_a_networks_protocol_gives_its_joints_their_counts_unless_a_zero_was_measured(tmp_path: Path) -> None:
    own = written(tmp_path, '[network.arm]\nprotocol = "feetech"\n[[joint]]\nname = "elbow"\ncentre_count = 2100.0\n')
    for robot in (Robot.load(override=own), Robot.from_data(Robot.load(override=own).to_data())):
        zeros = [robot.joints[name].centre_count for name in ("shoulder", "elbow", "claw_left")]
        assert zeros == [2048.0, 2100.0, 511.5]
        assert robot.joints["shoulder"].to_angle(2048 + 1024) == pytest.approx(radians(90))


def test_a_description_from_before_networks_had_a_protocol_is_of_dynamixels() -> None:
    data = ROBOT.to_data()
    for network in data["network"].values():
        del network["protocol"]
    for joint in data["joint"]:
        joint["centre_count"] = 511.5  # as it is in every older capture
    assert Robot.from_data(data).joints == ROBOT.joints
    assert fingerprint_of(Robot.from_data(data)) == fingerprint_of(ROBOT)


def test_a_protocol_that_nobody_speaks_and_a_joint_without_a_network_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Invalid enum value 'morse'"):
        Robot.load(override=written(tmp_path, '[network.arm]\nprotocol = "morse"\n'))
    data = ROBOT.to_data()
    del data["network"]["hand"]
    with pytest.raises(ConfigError, match="joint wrist_roll: there is no network 'hand'"):
        Robot.from_data(data)


# --- camera ---------------------------------------------------------------------------------------


def test_the_camera_has_the_papers_field_of_view() -> None:
    camera = ROBOT.camera
    assert (camera.fx, camera.fy) == pytest.approx((585.8, 609.7), abs=0.05)
    left, right = camera.ray(-0.5, camera.cy), camera.ray(camera.width - 0.5, camera.cy)
    assert [left[0], right[0]] == pytest.approx([-tan(0.5), tan(0.5)])
    assert camera.ray(camera.cx, -0.5)[1] == pytest.approx(-tan(0.375))


@given(width=st.sampled_from([160, 320, 1280]), share=st.floats(0, 1), down=st.floats(0, 1))
def test_at_another_size_the_same_share_of_the_image_is_the_same_ray(width: int, share: float, down: float) -> None:
    def ray(camera: Camera) -> list[float]:
        return list(camera.ray(share * camera.width - 0.5, down * camera.height - 0.5))

    assert ray(ROBOT.camera.scaled(width, width * 3 // 4)) == pytest.approx(ray(ROBOT.camera))


# --- depth ----------------------------------------------------------------------------------------


@given(depth_m=st.floats(0.5, 3.5))
def test_a_depth_comes_back_within_a_step_of_the_code(depth_m: float) -> None:
    code = ROBOT.depth_code(np.array([depth_m]))
    here, beside = ROBOT.depth_m(code), ROBOT.depth_m(code + np.uint16(1))
    assert abs(float(here[0]) - depth_m) <= 0.51 * abs(float(beside[0] - here[0]))


@given(code=st.integers(0, 2046))
def test_a_code_comes_back_as_it_was(code: int) -> None:
    depth = ROBOT.depth_m(np.array([code], dtype=np.uint16))
    if ROBOT.eye.min_range_m <= depth[0] <= ROBOT.eye.max_range_m:
        assert ROBOT.depth_code(depth.astype(float))[0] == code


@pytest.mark.parametrize("depth_m", [0.0, 0.499, 3.501, 100.0, float("nan"), float("inf")])
def test_what_the_kinect_cannot_measure_has_no_code(depth_m: float) -> None:
    assert ROBOT.depth_code(np.array([depth_m]))[0] == 2047


def test_no_code_is_no_depth() -> None:
    assert np.isnan(ROBOT.depth_m(np.array([2047, 2048, 65535], dtype=np.uint16))).all()


# --- a robot's own file ---------------------------------------------------------------------------


def written(folder: Path, text: str) -> Path:
    file = folder / "own.toml"
    file.write_text(text)
    return file


def test_a_robots_own_file_changes_what_was_measured_and_nothing_else(tmp_path: Path) -> None:
    own = written(tmp_path, '[base]\nwheel_separation_m = 0.258\n[[joint]]\nname = "elbow"\ncentre_count = 515.0\n')
    robot = Robot.load(override=own)
    assert robot.base.wheel_separation_m == 0.258
    assert robot.base.wheel_radius_m == ROBOT.base.wheel_radius_m
    assert robot.joints["elbow"].centre_count == 515.0
    assert robot.joints["elbow"].limits_deg == ROBOT.joints["elbow"].limits_deg
    assert list(robot.joints) == list(ROBOT.joints)
    assert list(robot.links) == list(ROBOT.links)


def test_a_description_comes_back_from_plain_data() -> None:
    robot = Robot.from_data(ROBOT.with_base(command_timeout_s=9.0).to_data())
    assert robot.base.command_timeout_s == 9.0
    assert robot.joints == ROBOT.joints
    assert robot.links == ROBOT.links


@pytest.mark.parametrize("speed_mps", [-0.5, 0.0, 0.1, 0.35, 0.48, 0.5])
def test_patience_and_the_ramp_that_follows_it_stay_within_the_time_to_stand(speed_mps: float) -> None:
    base = ROBOT.base
    patience_s = base.patience_s(speed_mps)
    assert 2 / 50.0 < patience_s <= base.command_timeout_s, "two commands at least"
    ramp_s = abs(speed_mps) / base.wheel_acceleration_mps2
    assert patience_s + ramp_s <= base.stand_within_s - base.stand_reserve_s + 1e-12
    assert base.speed_at_age_mps(patience_s) >= abs(speed_mps) - 1e-12
    assert base.speed_at_age_mps(base.stand_within_s) == 0.0


def test_a_robot_whose_wheels_ramp_too_slowly_for_a_speed_is_not_patient_at_it() -> None:
    base = ROBOT.with_base(wheel_acceleration_mps2=1.0).base
    assert base.patience_s(0.5) == 0.0
    assert base.patience_s(0.2) > 0.0


def test_a_description_from_before_there_was_a_time_to_stand_has_one() -> None:
    data = ROBOT.to_data()
    for name in ("stand_within_s", "stand_reserve_s"):
        del data["base"][name]
    assert Robot.from_data(data).base.stand_within_s == ROBOT.base.stand_within_s


def test_a_description_from_before_it_had_a_hull_gets_the_calliopes_and_its_own_deadman() -> None:
    data = ROBOT.with_base(command_timeout_s=9.0).to_data()
    del data["hull"], data["claw"]["level_roll_deg"]
    for row in data["network"].values():
        del row["command_timeout_s"]
    recorded = deepcopy(data)
    robot = Robot.from_data(data)
    assert data == recorded
    assert robot.hull == ROBOT.hull
    assert robot.claw == ROBOT.claw
    assert {row.command_timeout_s for row in robot.networks.values()} == {9.0}


def test_a_measured_tube_of_the_hull_changes_that_one_alone(tmp_path: Path) -> None:
    robot = Robot.load(override=written(tmp_path, '[[hull.tube]]\nname = "forearm"\nradius_m = 0.04\n'))
    assert [tube.radius_m for tube in robot.hull.tube] == [0.025, 0.04, 0.025, 0.03]
    assert robot.hull.tube[1].balls == ROBOT.hull.tube[1].balls


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('[[hull.tube]]\nname = "forearm"\nend = "nowhere"\n', "hull.tube forearm: there is no link 'nowhere'"),
        ("[hull]\nfinger_turn_deg = { claw_middle = 1.0 }\n", "hull.finger_turn_deg: there is no link 'claw_middle'"),
        ("[hull]\nkinect_max_m = [0.13, -0.2, 0.79]\n", r"own\.toml: hull\.kinect_min_m: .* must be below"),
        ("[kinect]\nmount_min_m = [0.0, 0.0, 9.0]\n", r"own\.toml: camera kinect: mount_min_m: .* must be below"),
    ],
)
def test_a_hull_or_mount_that_cannot_be_is_refused(tmp_path: Path, text: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        Robot.load(override=written(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('[arm]\ntip = "nowhere"\n', r"own\.toml: arm\.tip: there is no link 'nowhere'"),
        ('[kinect]\nlink = "nowhere"\n', "camera kinect: link: there is no link 'nowhere'"),
        ('[arm]\nroll = "knuckle"\n', "arm: there is no joint 'knuckle'"),
        ('[head]\npan = "knuckle"\n', "head: there is no joint 'knuckle'"),
        ('[arm]\nbend = "neck_tilt"\n', "arm: bend = 'neck_tilt' is none of its joints arm_base, shoulder"),
        ('[[link]]\nname = "elbow"\njoint = "shoulder"\n', "arm: the joint 'elbow' moves no link"),
        ('[arm]\njoints = ["arm_base"]\n', "arm.joints"),
        ("[pose.spread]\nknuckle = 1.0\n", "pose spread: there is no joint 'knuckle'"),
        ('[solid]\ntouching = [["riser", "nowhere"]]\n', "solid.touching: there is no link 'nowhere'"),
        ('[[solid.part]]\nname = "palm"\nlink = "nowhere"\n', "part palm: there is no link 'nowhere'"),
        ('[[solid.part]]\nname = "palm"\nsize_m = [0.1]\n', "part palm: size_m of a box is 3 lengths"),
    ],
)
def test_what_the_names_stand_for_must_be_there(tmp_path: Path, text: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        Robot.load(override=written(tmp_path, text))


def test_a_pose_that_an_arm_needs_names_each_of_its_joints() -> None:
    data = ROBOT.to_data()
    del data["pose"]["upright"]["elbow"]
    with pytest.raises(ConfigError, match="pose upright: the angle of 'elbow' is missing"):
        Robot.from_data(data)


def test_the_two_networks_have_deadmen_of_their_own(tmp_path: Path) -> None:
    robot = Robot.load(override=written(tmp_path, "[network.hand]\ncommand_timeout_s = 0.5\n"))
    assert {name: row.command_timeout_s for name, row in robot.networks.items()} == {"arm": 0.15, "hand": 0.5}
    assert {row.command_timeout_s for row in ROBOT.with_networks(command_timeout_s=2.0).networks.values()} == {2.0}


def test_another_deadman_leaves_the_robot_itself_alone() -> None:
    assert ROBOT.with_base(command_timeout_s=9.0).base.command_timeout_s == 9.0
    assert ROBOT.base.command_timeout_s == 0.15


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[base]\nwheel_separation_m = 'wide'\n", r"own\.toml.*\$\.base\.wheel_separation_m"),
        ("[base]\nwheel_separation_m = -0.1\n", r"\$\.base\.wheel_separation_m"),
        ("[base]\nwheels = 3\n", r"wheels"),
        ("[base\n", r"own\.toml"),
        ('[[joint]]\nname = "tail"\n', r"own\.toml.*\$\.joint\[9\].*new name needs all fields"),
        ('[[link]]\nname = "shoulder"\nparent = "nowhere"\n', r"shoulder.*nowhere"),
        ('[[link]]\nname = "arm_base"\nparent = "gripper"\n', r"arm_base.*circle"),
        ('[[link]]\nname = "elbow"\njoint = "knee"\n', r"elbow.*knee"),
        ('[[joint]]\nname = "elbow"\nlimits_deg = [10.0, -10.0]\n', r"elbow.*limits"),
        ('[marker]\nlink = "tail"\n', r"marker.*tail"),
        ("[pose.park]\ntail = 1.0\n", r"park.*tail"),
    ],
)
def test_a_mistake_is_named_with_its_file_and_field(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=f"(?s){says}"):
        Robot.load(override=written(tmp_path, text))


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for missing in ({"path": tmp_path / "none.toml"}, {"override": tmp_path / "none.toml"}):
        with pytest.raises(ConfigError, match=r"none\.toml"):
            Robot.load(**missing)
    unreadable = tmp_path / "binary.toml"
    unreadable.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"binary\.toml"):
        Robot.load(unreadable)


def test_a_description_without_a_field_is_refused_with_the_place_that_has_it(tmp_path: Path) -> None:
    whole = tmp_path / "whole.toml"
    whole.write_text(TEXT.replace("level_roll_deg = 90.0", "", 1))
    with pytest.raises(ConfigError, match=r"whole\.toml: .*level_roll_deg.*calliope\.toml has every field"):
        Robot.load(whole)
    with pytest.raises(ConfigError, match=r"whole\.toml with .*own\.toml: .*level_roll_deg"):
        Robot.load(whole, written(tmp_path, "[base]\nmass_kg = 10.0\n"))


def test_a_whole_description_of_ones_own_is_read(tmp_path: Path) -> None:
    assert Robot.load(written(tmp_path, TEXT.replace('name = "calliope"', 'name = "ada"', 1))).name == "ada"
