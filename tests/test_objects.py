"""The catalogue of known objects."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cocoro.errors import ConfigError
from cocoro.objects import Catalogue, ObjectSpec
from cocoro.robot import Robot
from services.perception.colours import ColourTable, lab_of, matches
from sim.render.views import lamp_tint

BALL = """
[[object]]
label = "ball"
shape = "sphere"
radius_m = 0.03
rgb = [1, 0, 0]
lab = [{ low = [10, 20, 10], high = [60, 80, 70] }]
"""


def load(tmp_path: Path, text: str) -> Catalogue:
    path = tmp_path / "things.toml"
    path.write_text(text)
    return Catalogue.load(path)


def test_the_projects_own_objects_are_the_three_cans_two_balls_and_the_marker() -> None:
    catalogue = Catalogue.load()
    assert catalogue.labels == (
        "red_can", "green_can", "blue_can", "yellow_ball", "blue_ball", "hand_marker",
    )  # fmt: skip
    for label in ("red_can", "green_can", "blue_can"):
        assert catalogue[label].size_m == pytest.approx((0.066, 0.066, 0.120))
        assert catalogue[label].graspable
        assert catalogue[label].mass_kg == 0.2
    assert catalogue["yellow_ball"].size_m == pytest.approx((0.060,) * 3)
    assert catalogue["blue_ball"].size_m == pytest.approx((0.080,) * 3)
    assert catalogue.marker is catalogue["hand_marker"]
    assert catalogue["hand_marker"].size_m == pytest.approx((0.025,) * 3)
    assert "hand_marker" not in [known.label for known in catalogue.targets]


def test_the_marker_is_as_large_as_the_robot_description_says() -> None:
    assert Catalogue.load()["hand_marker"].radius_m == Robot.load().the_marker.radius_m


def test_a_label_that_is_not_there_is_told_apart_from_one_that_is() -> None:
    catalogue = Catalogue.load()
    assert "red_can" in catalogue
    assert "teapot" not in catalogue
    assert catalogue.get("teapot") is None
    with pytest.raises(KeyError):
        catalogue["teapot"]


def test_a_box_has_its_own_size_and_a_planar_radius_of_equal_area(tmp_path: Path) -> None:
    box = BALL.replace('"sphere"', '"box"').replace("radius_m = 0.03", "size_m = [0.1, 0.2, 0.3]")
    known = load(tmp_path, box)["ball"]
    assert known.size_m == (0.1, 0.2, 0.3)
    assert np.pi * known.planar_radius_m**2 == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("was", "becomes", "complaint"),
    [
        ("radius_m = 0.03", "", "a sphere needs radius_m"),
        ("radius_m = 0.03", "radius_m = 0.03\nheight_m = 1", "a sphere has no height_m"),
        ("radius_m = 0.03", "radius_m = -1", "radius_m: Expected `float` > 0.0"),
        ("radius_m = 0.03", "radius_m = 0.03\ncolour = 1", "unknown field 'colour'; known are label, "),
        ('"sphere"', '"cylinder"', "a cylinder needs height_m"),
        ('"sphere"', '"cone"', "shape: unknown value 'cone'; known are cylinder, sphere, box"),
        ("rgb = [1, 0, 0]", "rgb = [1, 0, 2]", "rgb[2]: Expected `float` <= 1.0"),
        ("rgb = [1, 0, 0]", "", "missing required field `rgb`"),
        ("high = [60, 80, 70]", "high = [60, 80]", "lab[0].high: Expected `array` of length 3"),
        ("high = [60, 80, 70]", "high = [60, 10, 70]", "lab[0]: a must rise within -128 to 127, not 20 to 10"),
        ("high = [60, 80, 70]", "high = [255, 80, 70]", "lab[0]: L must rise within 0 to 100"),
        ("lab = [{ low = [10, 20, 10], high = [60, 80, 70] }]", "lab = []", "lab: Expected `array` of length >= 1"),
        ('label = "ball"', 'label = "a ball"', "label: Expected `str` matching regex"),
    ],
)
def test_an_error_names_file_table_and_field(tmp_path: Path, was: str, becomes: str, complaint: str) -> None:
    assert was in BALL
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, BALL.replace(was, becomes))
    text = str(caught.value)
    assert complaint in text
    assert "things.toml" in text
    assert "[[object]] 1" in text


def test_a_label_and_the_marker_are_given_once(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\[\[object\]\] 2 \(ball\): label: an earlier object has it"):
        load(tmp_path, BALL + BALL)
    marker = BALL.replace("rgb", "marker = true\nrgb")
    with pytest.raises(ConfigError, match="marker: ball is the marker"):
        load(tmp_path, marker + marker.replace('"ball"', '"other"'))


@pytest.mark.parametrize("text", ["", "object = 3", "[object]", "[[object]", "[[thing]]\nlabel = 'x'"])
def test_a_file_without_object_tables_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=r"things\.toml"):
        load(tmp_path, text)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml"):
        Catalogue.load(tmp_path / "nowhere.toml")


# --- colours --------------------------------------------------------------------------------------


def colours_in_changing_light(rgb: tuple[float, float, float], count: int = 4000) -> NDArray[np.uint8]:
    """The surface's colour as the camera gives it, 8-bit RGB, (count, 3): lit and in its own shade, under lamps of 4500
    to 8000 K, with exposure +-10%, white balance +-5% and the noise that is left after a 3 x 3 mean."""
    draws = np.random.default_rng(5)
    tints = np.array([lamp_tint(kelvin) for kelvin in np.linspace(4500, 8000, 50)])[draws.integers(0, 50, count)]
    light = draws.uniform(0.40, 1.0, (count, 1)) * draws.uniform(0.9, 1.1, (count, 1))
    balance = draws.uniform(-0.05, 0.05, (count, 1)) * np.array([1.0, 0.0, -1.0])
    values = 255 * np.array(rgb) * light * tints * (1 + balance) + draws.normal(0, 4 / 3, (count, 3))
    colours: NDArray[np.uint8] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return colours


@pytest.mark.parametrize("known", Catalogue.load(), ids=lambda known: known.label)
def test_a_colour_range_holds_in_changing_light_and_takes_no_other_objects_colour(known: ObjectSpec) -> None:
    own = lab_of(colours_in_changing_light(known.rgb))
    assert matches(known, own).mean() > 0.99
    for other in Catalogue.load():
        if other.label != known.label:
            assert matches(other, own).mean() < 0.001, other.label


@pytest.mark.parametrize(
    "rgb",
    [(0.5, 0.49, 0.47), (0.7, 0.7, 0.69), (0.13, 0.13, 0.14), (0.45, 0.45, 0.46), (0.95, 0.95, 0.95),
     (0.55, 0.40, 0.25), (0.6, 0.3, 0.2), (0.85, 0.65, 0.55)],
    ids=["floor", "wall", "servo", "arm", "paper", "wood", "brick", "skin"],
)  # fmt: skip
def test_rooms_robots_and_people_have_no_objects_colour(rgb: tuple[float, float, float]) -> None:
    colours = lab_of(colours_in_changing_light(rgb))
    for known in Catalogue.load():
        assert matches(known, colours).mean() < 0.01, known.label


def test_the_colour_table_says_what_the_ranges_say() -> None:
    catalogue = Catalogue.load()
    table = ColourTable(catalogue)
    for number, known in enumerate(catalogue):
        shades = np.linspace(0.5, 1.0, 20)[:, None, None, None] * np.array(known.rgb) * 255
        for shade in np.rint(shades).astype(np.uint8):
            codes = table.packed(np.ascontiguousarray(np.broadcast_to(shade, (8, 8, 3))))
            assert (codes == codes[0, 0]).all()
            labels = [int(layer.table[codes[0, 0]]) for layer in table.layers]
            assert labels[table.layer_of[number]] == 1 + number, (known.label, shade)
            sharing = {0} | {1 + i for i, other in enumerate(catalogue) if other is known or other.lab_by_shape}
            assert set(labels) <= sharing, (known.label, shade)


def test_objects_that_share_a_colour_are_in_different_layers_of_the_table(tmp_path: Path) -> None:
    def many(count: int) -> Catalogue:
        return load(tmp_path, "".join(BALL.replace('"ball"', f'"ball_{i}"') for i in range(count)))

    table = ColourTable(many(9))
    red = table.packed(np.full((4, 4, 3), (200, 20, 20), dtype=np.uint8))
    assert [int(layer.table[red[0, 0]]) for layer in table.layers] == list(range(1, 10))
    with pytest.raises(ValueError, match="256 known objects"):
        ColourTable(many(256))
