"""The URDF of the page on robots of one's own: it becomes a robot that reaches, without a value set by hand."""

from __future__ import annotations

from pathlib import Path

import pytest
from spelled import asked

from apps.cli.main import main
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from apps.urdf.describing import describe
from cocoro.robot import Robot
from services.planning.clearance import Clearance
from services.planning.config import ArmConfig
from services.planning.reach import HandPose, Reacher

URDF = Path(__file__).parents[1] / "docs" / "robots" / "small-arm.urdf"


@pytest.fixture(scope="module")
def ada(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its description, with what lies beside it."""
    folder = tmp_path_factory.mktemp("robots")
    assert main(["new", "robot", "ada", "--urdf", str(URDF), "--into", str(folder)]) == 0
    return folder / "ada" / "ada.toml"


def test_it_reaches_where_its_description_says_clear_of_its_base_and_bent_as_upright(ada: Path) -> None:
    robot, config = Robot.load(ada), ArmConfig()
    assert robot.reach is not None
    reacher, clearance = Reacher(robot, config.damping), Clearance(robot)
    bend, straight_rad = robot.arm.bend, robot.arm.straight_rad
    assert robot.arm.straight_deg == pytest.approx(-90.0)
    for radius_m in (robot.reach.retreat_radius_m, *robot.reach.grasp_radius_range_m):
        found = reacher.solve(reacher.upright, HandPose(radius_m, 0.0, 0.05, config.pitch_rad))
        assert found is not None
        assert clearance.of(reacher.upright | found) > config.clearance_m
        assert (found[bend] - straight_rad) * (robot.poses["upright"][bend] - straight_rad) > 0.0
    park = dict.fromkeys(robot.joints, 0.0) | robot.poses["park"]
    assert abs(park[robot.arm.azimuth]) > 1.3
    assert clearance.of(park) > config.clearance_m


@pytest.mark.sim
def test_it_touches_a_can_in_its_own_scene(ada: Path) -> None:
    request = RehearsalRequest(
        task=asked("touch", "red_can").task, description=str(ada), scene="targets",
        width=320, height=240, frame_rate_hz=15.0,
    )  # fmt: skip
    result = rehearse(request)
    assert (result["outcome"], result["reason"]) == ("done", "")
    assert result["truth"]["collisions"] == ()


@pytest.mark.parametrize("more", [1, 2])
def test_an_arm_of_more_joints_reaches_as_well(tmp_path: Path, more: int) -> None:
    text, axes = URDF.read_text(encoding="utf-8"), ("0 0 1", "0 1 0")
    inertial = text[text.index("<inertial>") : text.index("</inertial>")] + "</inertial>"
    above, joints = "wrist", ""
    for number in range(more):
        joints += (
            f'<link name="knuckle{number}">{inertial}</link><joint name="more{number}" type="revolute">'
            f'<parent link="{above}"/><child link="knuckle{number}"/><origin xyz="0.01 0 0"/>'
            f'<axis xyz="{axes[number]}"/><limit lower="-1.5" upper="1.5" effort="3" velocity="4"/></joint>'
        )
        above = f"knuckle{number}"
    file = tmp_path / "longer.urdf"
    longer = text.replace('<parent link="wrist"/>', f'<parent link="{above}"/>').replace(
        "</robot>", f"{joints}</robot>"
    )
    file.write_text(longer, encoding="utf-8")
    made = describe(file, "ada", postures=True)
    robot = made.robot
    assert len(robot.arm.joints) == 4 + more
    assert robot.reach is not None
    reacher = Reacher(robot, ArmConfig().damping)
    for radius_m in robot.reach.grasp_radius_range_m:
        assert reacher.solve(reacher.upright, HandPose(radius_m, 0.3, 0.05, ArmConfig().pitch_rad)) is not None
