"""Scene files: valid contents, and the error messages for invalid ones."""

from __future__ import annotations

from math import atan2, degrees, hypot, pi
from pathlib import Path

import pytest

from cocoro.errors import ConfigError
from sim.scene import Scene, load_scene
from sim.scene_names import scene_names

CAN = """
[[object]]
label = "red_can"
shape = "cylinder"
radius_m = 0.033
height_m = 0.12
position_m = [1.0, 0.0]
"""


def scene_of(tmp_path: Path, text: str, seed: int = 0) -> Scene:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return load_scene(path, seed)


def problem(tmp_path: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        scene_of(tmp_path, text)
    return str(caught.value)


def test_the_paper_scene_has_the_papers_three_cans_where_it_put_them() -> None:
    scene = load_scene("paper", seed=3)
    places = {
        item.label: (hypot(*item.position_m), degrees(atan2(item.position_m[1], item.position_m[0])))
        for item in scene.objects
    }
    for label, reach_m, bearing_deg in (
        ("red_can", 1.5, 0.0),
        ("green_can", 1.4, -45.0),
        ("blue_can", 1.0, 45.0),
    ):
        assert places[label][0] == pytest.approx(reach_m, abs=0.021)
        assert places[label][1] == pytest.approx(bearing_deg, abs=1.3)


def test_every_scene_of_the_project_loads() -> None:
    assert "paper" in scene_names()
    for name in scene_names():
        assert load_scene(name, seed=1).objects


def test_the_seed_scatters_and_the_same_seed_scatters_alike() -> None:
    assert load_scene("paper", 1) == load_scene("paper", 1)
    assert load_scene("paper", 1) != load_scene("paper", 2)


def test_everything_but_label_shape_size_and_position_has_a_default(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, CAN)
    (can,) = scene.objects
    assert scene.name == "mine"
    assert can.mass_kg == 0.2
    assert can.colour[0] > 0.7 > 0.1 > can.colour[1]  # by its label, red
    assert can.centre_m == (1.0, 0.0, 0.06)  # it stands on the floor
    assert not can.kinematic
    assert scene.robot.position_m == (0.0, 0.0)


def test_a_third_coordinate_is_the_height_of_the_centre(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, CAN.replace("[1.0, 0.0]", "[1.0, 0.0, 0.5]") + "floating = true\n")
    assert scene.objects[0].centre_m == (1.0, 0.0, 0.5)
    assert scene.objects[0].kinematic


def test_positions_are_in_the_frame_of_the_robots_start(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, CAN + f"[robot]\nposition_m = [2.0, 3.0]\nyaw_rad = {pi / 2}\n")
    assert scene.to_world(scene.objects[0].centre_m) == pytest.approx((2.0, 4.0, 0.06))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            CAN.replace("0.033", "-0.033"),
            "scene mine.toml, [[object]] 1 'red_can': radius_m must be > 0",
        ),
        (
            CAN.replace("radius_m = 0.033\n", ""),
            "scene mine.toml, [[object]] 1 'red_can': radius_m is missing: a cylinder needs radius_m and height_m",
        ),
        (
            CAN + "size_m = [1.0, 1.0, 1.0]\n",
            "scene mine.toml, [[object]] 1 'red_can': size_m does not belong to a cylinder, "
            "which has radius_m and height_m",
        ),
        (
            CAN + 'mass_kg = "heavy"\n',
            "scene mine.toml, [[object]] 1 'red_can': mass_kg: Expected `float`, got `str`",
        ),
        (
            CAN + "colour = 3\n",
            "scene mine.toml, [[object]] 1 'red_can': unknown field 'colour'; known are",
        ),
        (CAN + "mass_kg = 0.0\n", "scene mine.toml, [[object]] 1 'red_can': mass_kg must be > 0"),
        (CAN + "mass_kg = nan\n", "scene mine.toml, [[object]] 1 'red_can': mass_kg must be finite"),
        (CAN + "rgb = [255, 0, 0]\n", "scene mine.toml, [[object]] 1 'red_can': rgb must be 0 to 1 a channel"),
        (
            CAN + "path_m = [[1.0, 1.0]]\n",
            "scene mine.toml, [[object]] 1 'red_can': speed_mps must be > 0 for an object with a path_m",
        ),
        (
            CAN + "speed_mps = 0.1\n",
            "scene mine.toml, [[object]] 1 'red_can': path_m is missing: "
            "an object with a speed_mps needs its waypoints",
        ),
        (CAN + CAN, "scene mine.toml, [[object]] 2 'red_can': label is taken by another object"),
        (CAN.replace("red_can", "red can"), "[[object]] 1 'red can': label must be one word"),
        (CAN.replace("[1.0, 0.0]", "[1.0]"), "[[object]] 1 'red_can': position_m: Expected `array` of length"),
        (CAN + "[light]\nambient = 2.0\n", "scene mine.toml, [light]: ambient must be 0 to 1"),
        (CAN + "[light]\ndirection = [0, 0, 0]\n", "scene mine.toml, [light]: direction must not be zero"),
        (CAN + "[lamp]\n", "scene mine.toml: unknown table or field 'lamp'"),
        ("[object]\n", "scene mine.toml: [object] must be written [[object]], once for each"),
        (
            "[[obstacle]]\nshape = 'cone'\n",
            "scene mine.toml, [[obstacle]] 1: shape: unknown value 'cone'; known are box, cylinder, sphere",
        ),
        ("[[object]\n", "scene mine.toml: not TOML: "),
        ("name = 5\n", "scene mine.toml: name must be text"),
    ],
)
def test_an_error_names_the_field_and_its_table(tmp_path: Path, text: str, message: str) -> None:
    assert message in problem(tmp_path, text)


def test_an_unknown_scene_is_told_which_ones_there_are(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no scene 'papr', and no such .toml file; .*did you mean paper"):
        load_scene("papr")
    with pytest.raises(ConfigError, match="No such file"):
        load_scene(tmp_path / "none.toml")
