"""`cocoro new robot NAME --urdf FILE`: what it writes runs, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from urdf_rig import DESK_ARM, desk_arm

from apps.cli.main import main
from cocoro.robot import Robot
from deploy import profiles
from sim.random_scene import find_scene
from sim.world import World


@pytest.fixture
def written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    assert main(["new", "robot", "ada", "--urdf", str(desk_arm(tmp_path)), "--into", str(tmp_path)]) == 0
    said = capsys.readouterr()
    folder = tmp_path / "ada"
    assert all(str(path) in said.out for path in folder.iterdir())
    assert f"cocoro up {folder / 'ada-sim.toml'}" in said.out
    assert not said.err
    return folder


def test_it_writes_a_description_a_profile_and_the_page_of_what_is_missing(written: Path) -> None:
    own = {f"ada-{name}.toml" for name in ("sim", "objects", "paper", "targets")}
    assert {path.name for path in written.iterdir()} - own == {"ada.toml", "WHAT-IS-MISSING.md"}
    profile = profiles.read(str(written / "ada-sim.toml"))
    assert (profile.robot, profile.clock) == ("ada", "sim")
    robot = Robot.load(*profile.robot_files)
    assert robot.name == "ada"
    assert "desk.urdf" in (written / "WHAT-IS-MISSING.md").read_text(encoding="utf-8")


@pytest.mark.sim
def test_the_world_of_its_profile_runs_and_the_robot_stands_still_in_it(written: Path) -> None:
    profile = profiles.read(str(written / "ada-sim.toml"))
    robot = Robot.load(*profile.robot_files)
    with World(robot, find_scene(profile.service["sim"]["scene"], 0)) as world:
        world.set_latch("released")
        start = world.link_pose("body")
        park = robot.poses["park"]
        for _ in range(2 * 240):
            world.step()
        state = world.servo_state("arm")
        angles = dict(zip(state.joints, state.position_rad, strict=True))
        assert np.linalg.norm(world.link_pose("body")[:3, 3] - start[:3, 3]) < 0.002
        assert all(abs(angles[name] - park[name]) < 0.05 for name in park)


@pytest.mark.parametrize(
    ("name", "complaint"),
    [("Ada", "is not a valid name"), ("9lives", "is not a valid name"), ("a/b", "is not a valid name")],
)
def test_a_name_that_cannot_be_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, complaint: str
) -> None:
    urdf = desk_arm(tmp_path)
    assert main(["new", "robot", name, "--urdf", str(urdf), "--into", str(tmp_path / "here")]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "here").exists()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("no xml", "desk.urdf: is not XML"),
        ('<robot name="r"/>', "desk.urdf: has no links"),
        (DESK_ARM.replace('parent link="upper"', 'parent link="lower"'), "desk.urdf: has a loop of links"),
        (DESK_ARM.replace('name="bend" type="revolute"', 'name="bend" type="prismatic"'), "joint bend is of type"),
    ],
)
def test_a_file_that_no_robot_can_be_made_of_ends_with_one_line_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, complaint: str
) -> None:
    urdf = desk_arm(tmp_path, text)
    assert main(["new", "robot", "ada", "--urdf", str(urdf), "--into", str(tmp_path / "here")]) == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "here").exists()


def test_without_a_urdf_it_says_how_to_give_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", "robot", "ada", "--into", str(tmp_path)]) == 2
    assert "--urdf" in capsys.readouterr().err


def test_what_is_there_is_never_written_over(written: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (written / "ada.toml").write_text("mine")
    assert (
        main(["new", "robot", "ada", "--urdf", str(written.parent / "desk.urdf"), "--into", str(written.parent)]) == 2
    )
    assert "exists already" in capsys.readouterr().err
    assert (written / "ada.toml").read_text() == "mine"


def test_a_file_name_that_is_no_text_does_not_break_what_is_written(tmp_path: Path) -> None:
    urdf = desk_arm(tmp_path).rename(tmp_path / "caf\udce9\n.urdf")
    assert main(["new", "robot", "ada", "--urdf", str(urdf), "--into", str(tmp_path)]) == 0
    assert "Made from caf??.urdf" in (tmp_path / "ada" / "ada.toml").read_text(encoding="utf-8")
    assert Robot.load(tmp_path / "ada" / "ada.toml").name == "ada"
