"""Learning a new object from one look: where it is, its colours, its size, what is said before it is kept."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from perception_scenes import CATALOGUE, ROBOT, Canvas, Scene, Thing, facing, known
from test_objects import colours_in_changing_light

from apps.appearance.colours import overlaps, range_of
from apps.appearance.learn import LearnedObject, ObjectHints, ObjectView, learn
from apps.appearance.region import ColourField, at_pixel, in_box, most_salient
from apps.pictures import colour_of
from cocoro.errors import ConfigError
from cocoro.messages import Frame
from cocoro.objects import Catalogue
from services.perception.cielab import in_boxes, lab_of

ORANGE, TEAL = (0.95, 0.45, 0.05), (0.05, 0.60, 0.55)


def look_at(frame: Frame, pan: float, tilt: float) -> ObjectView:
    raw_depth = np.frombuffer(frame.depth, dtype="<u2").reshape(frame.height, frame.width)
    pose = ROBOT.chain("camera").pose({"neck_pan": pan, "neck_tilt": tilt})
    return ObjectView(colour_of(frame), ROBOT, raw_depth, pose)


def rendered(*things: Thing, sensors: str = "real", size: tuple[int, int] = (640, 480)) -> ObjectView:
    """The first thing in the middle of what a real camera sees."""
    pan, tilt = facing(things[0])
    with Scene(list(things), sensors=sensors, width=size[0], height=size[1]) as scene:  # type: ignore[arg-type]
        return look_at(scene.frame(pan, tilt), pan, tilt)


def can(
    rgb: tuple[float, float, float], x: float, y: float = 0.0, radius_m: float = 0.03, height_m: float = 0.11
) -> Thing:
    return Thing("new", "cylinder", (radius_m, height_m), rgb, (x, y, height_m / 2))


@pytest.fixture(scope="module")
def orange() -> LearnedObject:
    """An orange can between known things, as a real camera sees it."""
    return learn(
        rendered(can(ORANGE, 1.2, 0.1), known("green_can", 1.5, -0.35), known("yellow_ball", 1.4, 0.5)),
        ObjectHints("orange_can"),
        CATALOGUE,
    )


@pytest.mark.sim
def test_a_new_can_in_the_middle_is_found_and_measured(orange: LearnedObject) -> None:
    assert orange.known.shape == "cylinder"
    assert orange.known.radius_m == pytest.approx(0.030, abs=0.002)
    assert orange.known.height_m == pytest.approx(0.110, abs=0.004)
    assert orange.known.graspable
    assert orange.known.rgb == pytest.approx(ORANGE, abs=0.08)
    assert orange.matched_share > 0.8
    assert orange.elsewhere == 0


@pytest.mark.sim
def test_its_colours_hold_in_changing_light_and_are_not_those_of_rooms_and_robots(orange: LearnedObject) -> None:
    own = lab_of(colours_in_changing_light(ORANGE))
    assert in_boxes(orange.range.boxes, own).mean() > 0.95
    for rgb in ((0.5, 0.49, 0.47), (0.7, 0.7, 0.69), (0.13, 0.13, 0.14), (0.45, 0.45, 0.46), (0.95, 0.95, 0.95)):
        assert in_boxes(orange.range.boxes, lab_of(colours_in_changing_light(rgb))).mean() < 0.01
    for other in CATALOGUE:
        taken = in_boxes(orange.range.lab, lab_of(colours_in_changing_light(other.rgb))).mean()
        assert taken < 0.05, other.label


@pytest.mark.sim
@pytest.mark.parametrize("size", [(640, 480), (320, 240)], ids=str)
def test_a_ball_is_told_from_a_can_and_measured(size: tuple[int, int]) -> None:
    ball = Thing("new", "sphere", (0.045,), TEAL, (1.1, 0.0, 0.045))
    learnt = learn(rendered(ball, size=size), ObjectHints("teal_ball"), CATALOGUE)
    assert learnt.known.shape == "sphere"
    assert learnt.known.radius_m == pytest.approx(0.045, abs=0.003)
    assert not learnt.known.graspable  # the claws do not open so far


# --- pointing -------------------------------------------------------------------------------------


Patch = tuple[tuple[int, int, int, int], tuple[int, int, int]]
"""(left, top, right, bottom), and the colour."""


def painted(*patches: Patch) -> ColourField:
    """Patches of a colour on noisy grey."""
    colour = np.full((240, 320, 3), 120, dtype=np.uint8)
    noise = np.random.default_rng(1).normal(0, 3, colour.shape)
    for (left, top, right, bottom), rgb in patches:
        colour[top:bottom, left:right] = rgb
    return ColourField(np.clip(colour + noise, 0, 255).astype(np.uint8))


RED_LEFT = ((60, 100, 90, 150), (200, 30, 30))
TEAL_RIGHT = ((220, 100, 250, 150), (20, 150, 140))
BOTH = (RED_LEFT, TEAL_RIGHT)


def near(box: tuple[int, int, int, int], wanted: tuple[int, int, int, int]) -> bool:
    return all(abs(a - b) <= 2 for a, b in zip(box, wanted, strict=True))


@pytest.mark.parametrize("patch", BOTH, ids=["red", "teal"])
def test_a_pixel_points_at_the_thing_that_it_is_of(
    patch: tuple[tuple[int, int, int, int], tuple[int, int, int]],
) -> None:
    (left, top, right, bottom), _ = patch
    region = at_pixel(painted(*BOTH), (left + right) // 2, (top + bottom) // 2)
    assert near(region.box, patch[0])
    assert region.area_px == pytest.approx((right - left) * (bottom - top), rel=0.08)


def test_a_box_points_at_what_fills_it_and_is_not_around_it() -> None:
    region = in_box(painted(*BOTH), (210, 85, 262, 165))
    assert near(region.box, TEAL_RIGHT[0])


def test_what_is_known_is_not_meant_when_something_else_stands_out() -> None:
    picture = painted(*BOTH)
    red = np.zeros((240, 320), dtype=np.bool_)
    red[95:155, 55:95] = True
    assert near(most_salient(picture, red).box, TEAL_RIGHT[0])


def test_a_label_on_a_thing_is_a_part_of_its_outline_but_none_of_its_colours() -> None:
    labelled = painted(((140, 80, 190, 160), (200, 30, 30)), ((155, 110, 175, 130), (240, 240, 240)))
    region = at_pixel(labelled, 165, 90)
    assert region.mask[120, 165]
    assert not region.coloured[120, 165]


def test_shading_does_not_split_a_thing() -> None:
    colour = np.full((240, 320, 3), 120, dtype=np.uint8)
    light = np.linspace(0.35, 1.0, 60)[None, :, None]
    colour[80:160, 130:190] = np.rint(np.array([40, 60, 220]) * light).astype(np.uint8)
    assert near(at_pixel(ColourField(colour), 180, 120).box, (130, 80, 190, 160))


@pytest.mark.parametrize(
    ("find", "complaint"),
    [
        (lambda: at_pixel(painted(*BOTH), 400, 10), "outside of the picture, which has 320 x 240"),
        (lambda: at_pixel(painted(((0, 0, 320, 240), (0, 0, 0))), 160, 120), "too dark"),
        (lambda: at_pixel(painted(*BOTH), 160, 10), "it is background"),
        (lambda: at_pixel(painted(((160, 120, 163, 123), (200, 30, 30))), 161, 121), "pixels"),
        (lambda: in_box(painted(*BOTH), (10, 10, 5, 20)), "not a box within 320 x 240"),
        (lambda: in_box(painted(*BOTH), (130, 90, 180, 160)), "colour"),
        (lambda: most_salient(painted()), "nothing in the picture stands out"),
    ],
    ids=["outside", "dark", "background", "speck", "inverted", "empty", "nothing"],
)
def test_where_there_is_no_thing_it_is_said_what_to_do(find: Callable[[], object], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        find()


# --- colours and warnings -------------------------------------------------------------------------


def patch_of(rgb: tuple[float, float, float]) -> np.ndarray:
    """Pixels (n, 3) of a colour as a camera sees it in one light: shaded from 55 to 100%."""
    draws = np.random.default_rng(2)
    values = 255 * np.array(rgb) * draws.uniform(0.55, 1.0, (900, 1)) + draws.normal(0, 1.3, (900, 3))
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def test_a_colour_of_its_own_overlaps_with_nothing() -> None:
    found = range_of(patch_of(TEAL), CATALOGUE)
    assert overlaps(found, CATALOGUE) == []
    assert len(found.lab) >= 5


def test_a_known_objects_colour_is_found_to_be_that() -> None:
    found = range_of(patch_of(CATALOGUE["red_can"].rgb), CATALOGUE)
    first = overlaps(found, CATALOGUE)[0]
    assert first.label == "red_can"
    assert first.of_new > 0.7
    assert first.of_known > 0.9
    assert found.lab  # some colour it must have


def test_a_few_pixels_of_another_colour_widen_nothing() -> None:
    clean = range_of(patch_of(TEAL))
    dirty = range_of(np.concatenate([patch_of(TEAL), patch_of((0.9, 0.9, 0.9))[:60]]))
    assert in_boxes(dirty.boxes, lab_of(patch_of((0.9, 0.9, 0.9)))).mean() < 0.02
    assert len(dirty.boxes) == len(clean.boxes)


def test_what_is_dark_has_no_colour() -> None:
    with pytest.raises(ConfigError, match="too dark"):
        range_of(np.full((500, 3), 2, dtype=np.uint8))


def look_of(canvas: Canvas) -> ObjectView:
    return look_at(canvas.frame(), 0.0, 0.0)


def canvas_with(rgb: tuple[int, int, int], depth_m: float | None = 1.0) -> Canvas:
    """A patch of 6 x 10 cm, 1 m away, in the picture's middle."""
    canvas = Canvas(320, 240)
    canvas.rectangle("red_can", (160.0, 120.0), depth_m, (0.06, 0.10), seen_at_m=1.0)
    canvas.colour[(canvas.colour != 128).any(axis=-1)] = rgb
    return canvas


def test_warnings_tell_of_grey_of_known_colours_and_of_other_places_of_that_colour() -> None:
    grey = learn(look_of(canvas_with((230, 230, 232))), ObjectHints("paper", at_px=(160, 120)), CATALOGUE)
    assert any("nearly grey" in warning for warning in grey.warnings)

    red = canvas_with((200, 12, 14))
    red.colour[25:45, 25:45] = (200, 12, 14)
    learnt = learn(look_of(red), ObjectHints("cup", at_px=(160, 120)), CATALOGUE)
    assert learnt.elsewhere == 1
    assert any(warning.startswith("red_can has colours in common with it") for warning in learnt.warnings)
    assert any("one more place in this picture has its colour" in warning for warning in learnt.warnings)


def test_relearning_an_object_is_not_warned_of_itself() -> None:
    learnt = learn(look_of(canvas_with((200, 12, 14))), ObjectHints("red_can", at_px=(160, 120)), CATALOGUE)
    assert "red_can" not in {overlap.label for overlap in learnt.overlaps}


def test_a_thing_cut_by_the_pictures_edge_is_said_to_be() -> None:
    canvas = Canvas(320, 240)
    canvas.colour[200:240, 150:170] = (20, 150, 140)
    learnt = learn(look_of(canvas), ObjectHints("cup", size_m=(0.06, 0.1)), CATALOGUE)
    assert any("touches the picture's edge" in warning for warning in learnt.warnings)


# --- size -----------------------------------------------------------------------------------------


def test_the_size_that_is_said_counts_and_says_the_shape() -> None:
    look = look_of(canvas_with((20, 150, 140), depth_m=None))
    cup = learn(look, ObjectHints("cup", size_m=(0.08, 0.1)), CATALOGUE).known
    assert (cup.shape, cup.radius_m, cup.height_m, cup.graspable) == ("cylinder", 0.04, 0.1, False)
    ball = learn(look, ObjectHints("ball", size_m=(0.05,)), CATALOGUE).known
    assert (ball.shape, ball.radius_m, ball.height_m) == ("sphere", 0.025, None)
    box = learn(look, ObjectHints("box", size_m=(0.2, 0.05, 0.1), graspable=False, mass_kg=0.4), CATALOGUE).known
    assert (box.shape, box.box_m, box.graspable, box.mass_kg) == ("box", (0.2, 0.05, 0.1), False, 0.4)


def test_a_distance_that_is_said_stands_in_for_depth() -> None:
    look = look_of(canvas_with((20, 150, 140)))
    picture = ObjectView(look.colour, ROBOT)
    learnt = learn(picture, ObjectHints("cup", distance_m=1.0), CATALOGUE)
    assert learnt.known.radius_m == pytest.approx(0.03, abs=0.002)
    assert learnt.known.height_m == pytest.approx(0.10, abs=0.005)
    assert any("assumed to look horizontally" in warning for warning in learnt.warnings)


@pytest.mark.parametrize(
    ("wanted", "picture", "complaint"),
    [
        (ObjectHints("cup"), True, "--size 0.066x0.12"),
        (ObjectHints("cup"), False, "no depth at the object"),
        (ObjectHints("cup", shape="sphere", size_m=(0.1, 0.2)), False, "a sphere has 1 lengths, not 2"),
    ],
)
def test_a_size_that_nobody_knows_is_asked_for(wanted: ObjectHints, picture: bool, complaint: str) -> None:
    look = look_of(canvas_with((20, 150, 140), depth_m=None))
    with pytest.raises(ConfigError, match=complaint):
        learn(ObjectView(look.colour, ROBOT) if picture else look, wanted, CATALOGUE)


def test_there_are_no_more_objects_than_can_be_told_apart() -> None:
    ball = CATALOGUE["yellow_ball"]
    many = Catalogue(tuple(msgspec.structs.replace(ball, label=f"ball_{number}") for number in range(32)))
    with pytest.raises(ConfigError, match="32 known objects"):
        learn(look_of(canvas_with((20, 150, 140))), ObjectHints("cup"), many)
