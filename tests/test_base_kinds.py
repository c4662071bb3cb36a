"""The kinds of bases in a robot description: what each needs, and contradictions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from omni_robot import WHEELS, omni_data, omni_robot

from cocoro.bus.local import LocalMesh
from cocoro.clock import VirtualClock
from cocoro.differential import Differential
from cocoro.errors import ConfigError
from cocoro.learning.handmap import fingerprint_of
from cocoro.node import Node
from cocoro.omni import Omni
from cocoro.robot import Robot
from services.base.service import BaseConfig, BaseService

ROBOT = Robot.load()
TEXT = Path("cocoro/calliope.toml").read_text()


def test_a_description_without_a_kind_is_of_a_differential_base() -> None:
    data = ROBOT.to_data()
    for field in ("kind", "wheel", "bumper"):  # as in captures of before there were kinds
        del data["base"][field]
    base = Robot.from_data(data).base
    assert base == ROBOT.base
    assert isinstance(base.drive, Differential)
    assert base.drive.lever_m == 0.261 / 2
    assert base.drive.names == ("left", "right")
    assert not base.drive.goes_aside


def test_an_omni_base_is_read_from_a_file(tmp_path: Path) -> None:
    text = TEXT.replace("wheel_separation_m = 0.261\nwheel_radius_m = 0.030\n", "", 1)
    text = text.replace('kind = "differential"', 'kind = "omni"', 1)
    for wheel in WHEELS:
        text += f'\n[[base.wheel]]\nname = "{wheel["name"]}"\n'
        text += "".join(f"{field} = {wheel[field]}\n" for field in ("distance_m", "angle_deg", "radius_m"))
    path = tmp_path / "omni.toml"
    path.write_text(text)
    robot = Robot.load(path)
    assert isinstance(robot.drive, Omni)
    assert robot.drive.names == ("left", "back", "right")
    assert robot.base.max_wheel_speed_mps == 0.5
    own = tmp_path / "own.toml"
    own.write_text('[[base.wheel]]\nname = "back"\ndistance_m = 0.127\n')
    measured = Robot.load(path, own)
    assert [wheel.distance_m for wheel in measured.base.wheel] == [0.125, 0.127, 0.125]
    assert Robot.from_data(measured.to_data()).base == measured.base
    with pytest.raises(ValueError, match="'omni' has no two wheels on one axle"):
        _ = robot.base.axle_m


@pytest.mark.parametrize(
    ("base", "says"),
    [
        ({"kind": "differential"}, "needs wheel_separation_m and wheel_radius_m"),
        ({"kind": "differential", "wheel_separation_m": 0.2}, "needs wheel_radius_m$|needs wheel_radius_m "),
        ({"kind": "differential", "wheel_separation_m": 0.2, "wheel_radius_m": 0.03}, "'omni' has"),
        ({"wheel_separation_m": 0.2}, "'omni' has no wheel_separation_m: each"),
        ({"wheel": WHEELS[:2]}, "three .* at least, not 2"),
        ({"wheel": [*WHEELS[:2], WHEELS[0]]}, "two wheels are called 'left'"),
        ({"wheel": [{**wheel, "drive_deg": 0.0} for wheel in WHEELS]}, "do not move the body"),
        ({"kind": "tracks"}, r"base\.kind.*tracks"),
        ({"wheel": [*WHEELS[:2], {**WHEELS[2], "radius_m": 0.0}]}, r"base\.wheel\[2\]\.radius_m"),
    ],
)
def test_a_base_that_contradicts_itself_is_named(base: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        Robot.from_data(omni_data(**base))


def test_a_calliope_with_omni_wheels_beside_its_own_is_refused() -> None:
    data = ROBOT.to_data()
    data["base"]["wheel"] = WHEELS
    with pytest.raises(ConfigError, match=r"'differential' has no \[\[base.wheel\]\]"):
        Robot.from_data(data)


def test_a_creates_service_refuses_another_base() -> None:
    node = Node("base", LocalMesh().join(), VirtualClock(), omni_robot())
    with pytest.raises(ConfigError, match=r"a Create has two wheels on one axle, but .* 'omni'"):
        BaseService(node, BaseConfig())


def test_learned_models_belong_to_the_wheels_of_their_base() -> None:
    moved = [{**wheel, "distance_m": 0.13} for wheel in WHEELS]
    prints = {fingerprint_of(robot) for robot in (ROBOT, omni_robot(), omni_robot(wheel=moved))}
    assert len(prints) == 3
