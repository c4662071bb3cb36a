"""Which robot `--robot NAME|FILE` means, what lies beside its description, and the former spelling of the option."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import pytest
from spelled import asked

from apps.cli.former import _renamed
from apps.cli.main import main
from apps.client.choice import RobotChoice
from apps.client.link import find
from apps.rehearsal.request import RehearsalRequest
from cocoro.errors import ConfigError, MeshError
from cocoro.objects import Catalogue
from cocoro.robot_files import RobotFiles, objects_beside, scene_beside
from deploy import profiles, which_robot
from deploy.rundir import RunDir
from services.planning.config import HandConfig
from services.planning.hand import widest_m
from sim.scene import load_scene


@pytest.fixture
def ada(tmp_path: Path) -> Path:
    """A robot's description with its own objects and one scene beside it."""
    lekiwi = resources.files("cocoro").joinpath("lekiwi.toml").read_text(encoding="utf-8")
    file = tmp_path / "ada.toml"
    file.write_text(lekiwi.replace('name = "lekiwi"', 'name = "ada"'), encoding="utf-8")
    (tmp_path / "ada-objects.toml").write_text("", encoding="utf-8")
    (tmp_path / "ada-paper.toml").write_text("", encoding="utf-8")
    return file


def up(monkeypatch: pytest.MonkeyPatch, root: Path, **resolved: dict[str, str]) -> None:
    """Robots that are up, by name with the profiles that they were started with."""
    there = []
    root.mkdir(mode=0o700)
    for name, data in resolved.items():
        run_dir = RunDir(name, root)
        run_dir.path.mkdir(parents=True)
        run_dir.path.chmod(0o700)
        run_dir.profile_file.write_text(json.dumps(data), encoding="utf-8")
        there.append(run_dir)
    monkeypatch.setattr(which_robot, "robots", lambda: there)
    monkeypatch.setattr("apps.client.link.robots", lambda: there)


def test_a_name_is_a_robot_that_is_up_then_one_that_is_shipped(
    ada: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    up(monkeypatch, tmp_path / "run")
    assert which_robot.files_of(None) == RobotFiles() == which_robot.files_here(None)
    shipped = which_robot.files_of("lekiwi")
    assert (shipped.name, shipped.load().name) == ("lekiwi", "lekiwi")
    assert shipped.objects == objects_beside("lekiwi")
    up(monkeypatch, tmp_path / "busy", lekiwi={"description": str(ada), "measured": "mine.toml"})
    running = which_robot.files_of("lekiwi")
    assert (running.description, running.measured) == (ada, Path("mine.toml"))
    assert which_robot.files_here(None) == running
    assert which_robot.files_of(None) == RobotFiles()


def test_a_file_is_a_description_and_on_a_mesh_the_robot_that_was_started_with_it(
    ada: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert which_robot.files_of(str(ada)) == RobotFiles("ada", ada, None, tmp_path / "ada-objects.toml")
    up(monkeypatch, tmp_path / "run", one={"description": str(ada)}, two={"description": "lekiwi"})
    assert find(RobotChoice(str(ada))).robot == "one"
    assert find(RobotChoice("two")).robot == "two"
    with pytest.raises(ConfigError, match="--robot one, --robot two"):
        find(RobotChoice())
    with pytest.raises(MeshError, match=r"no robot with the description .*up here: one, two"):
        find(RobotChoice(str(tmp_path / "other.toml")))
    with pytest.raises(ConfigError, match="choose one"):
        which_robot.files_here(None)


def test_what_is_no_robot_is_refused_with_what_to_do(ada: Path, tmp_path: Path) -> None:
    profile = tmp_path / "ada-sim.toml"
    profile.write_text('robot = "ada"\ndescription = "ada.toml"\nprocesses = ["sim"]\n', encoding="utf-8")
    (tmp_path / "broken.toml").write_text("x", encoding="utf-8")
    for given, why in (
        ("lekiwee", "lekiwi.*or give the .toml file"),
        (str(tmp_path / "none.toml"), "no such file; give a robot description, or a name: calliope, lekiwi"),
        (str(profile), f"that is a profile; give the description of its robot: --robot {ada}"),
        (str(tmp_path / "broken.toml"), "Expected"),
    ):
        with pytest.raises(ConfigError, match=f"--robot {given}: .*{why}"):
            which_robot.files_of(given)


def test_a_profile_of_another_robot_has_its_name_its_files_and_not_what_was_measured(ada: Path, tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('robot = "c"\nmeasured = "c-measured.toml"\nprocesses = ["sim", "planning"]\n', encoding="utf-8")
    own = profiles.read(str(file))
    assert (own.robot, own.description, own.objects, own.service) == ("c", None, None, {})
    other = which_robot.profile_of(str(file), str(ada))
    assert (other.robot, other.description, other.measured) == ("ada", str(ada), None)
    assert other.objects == str(tmp_path / "ada-objects.toml")
    assert other.service["sim"]["scene"] == str(tmp_path / "ada-paper.toml")
    assert which_robot.profile_of(str(file), "calliope").measured == own.measured
    assert which_robot.profile_of(str(file), str(ada), Path("m.toml")).measured == str(Path("m.toml").resolve())
    follow = profiles.read(str(file), ['description="lekiwi"', 'service.sim.scene="follow"', 'objects="o.toml"'])
    assert (follow.service["sim"]["scene"], follow.objects) == ("follow", str(tmp_path / "o.toml"))
    named = ada.with_name("bad.toml")
    named.write_text(ada.read_text(encoding="utf-8").replace('"ada"', '"Ada B"'), encoding="utf-8")
    with pytest.raises(ConfigError, match="name = 'Ada B': a name has"):
        which_robot.profile_of(str(file), str(named))


def test_a_rehearsal_takes_what_lies_beside_the_description_unless_it_is_told_otherwise(ada: Path) -> None:
    task = asked("fetch", "red_can").task
    own = RehearsalRequest(task=task, description=str(ada))
    assert (own.scene, own.objects) == (str(ada.with_name("ada-paper.toml")), str(ada.with_name("ada-objects.toml")))
    told = RehearsalRequest(task=task, description=str(ada), scene="follow", objects="mine.toml")
    assert (told.scene, told.objects) == ("follow", "mine.toml")
    assert (RehearsalRequest(task=task).scene, RehearsalRequest(task=task).objects) == ("paper", None)


def test_the_lekiwis_own_things_fit_into_its_hand_and_are_as_its_scenes_have_them() -> None:
    robot, objects = which_robot.files_of("lekiwi").load(), objects_beside("lekiwi")
    assert robot.reach is not None
    known, project = Catalogue.load(objects), Catalogue.load()
    assert known.labels == project.labels
    for item in known.targets:
        assert not item.graspable or 2 * item.planar_radius_m < widest_m(robot, HandConfig())
        assert item.lab == project[item.label].lab
    for name in ("paper", "targets"):
        file = scene_beside("lekiwi", name)
        assert file is not None
        for thing in load_scene(file, 0, known).objects:
            seen = known[thing.label]
            assert (thing.radius_m, thing.height_m) == (seen.radius_m, seen.height_m)
    assert scene_beside("lekiwi", "follow") is None
    assert objects_beside("calliope") is None
    assert objects_beside(None) is None


def test_a_description_has_what_lies_beside_the_one_that_it_is_based_on(tmp_path: Path) -> None:
    assert objects_beside("lekiwi-colour") == objects_beside("lekiwi")
    mine = tmp_path / "mine.toml"
    mine.write_text('based_on = "lekiwi"\nname = "mine"\n')
    assert (objects_beside(mine), scene_beside(mine, "paper")) == (
        objects_beside("lekiwi"),
        scene_beside("lekiwi", "paper"),
    )
    (tmp_path / "mine-objects.toml").write_text("")
    assert objects_beside(mine) == tmp_path / "mine-objects.toml"
    mine.write_text("based_on = 7")
    assert scene_beside(mine, "paper") is None


def test_the_former_spelling_is_taken_and_not_shown(capsys: pytest.CaptureFixture[str]) -> None:
    former = {"--description": "--robot"}
    assert _renamed(["a", "--description", "x", "--description=y", "--", "--description"], former) == [
        "a", "--robot", "x", "--robot=y", "--", "--description",
    ]  # fmt: skip
    for command in (["rehearse", "fetch", "red_can"], ["doctor"], ["servos", "limits", "elbow"]):
        assert main([*command, "--description", "nowhere.toml"]) == 2
        assert "--robot nowhere.toml: no such file" in capsys.readouterr().err
        assert main([*command, "--help"]) == 0
        assert "--description" not in capsys.readouterr().out


def test_what_a_body_without_a_marker_cannot_do_is_refused_before_the_first_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["experiment", "E6", "--robot", "lekiwi", "--seeds", "1", "--out", str(tmp_path / "out")]) == 2
    assert "lekiwi has no marker on its hand" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
