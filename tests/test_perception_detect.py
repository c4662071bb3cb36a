"""The two detectors on painted frames: what they must find, and what they must not mistake for an object."""

import msgspec
import numpy as np
import pytest
from perception_scenes import CATALOGUE, ROBOT, Canvas, seen, the

from cocoro.messages import Detections
from services.perception.config import PerceptionConfig
from services.perception.image import RgbdImage
from services.perception.paper import PaperDetector

SIZES = pytest.mark.parametrize("size", [(640, 480), (320, 240)], ids=["640x480", "320x240"])
DETECTORS = pytest.mark.parametrize("detector", ["blob", "paper"])


def middle(canvas: Canvas) -> tuple[float, float]:
    return canvas.camera.cx, canvas.camera.cy


def beside(canvas: Canvas, right: float, down: float = 0.0) -> tuple[float, float]:
    """A point beside the middle, in shares of the image's width."""
    width = canvas.camera.width
    return canvas.camera.cx + right * width, canvas.camera.cy + down * width


@SIZES
@DETECTORS
@pytest.mark.parametrize("label", CATALOGUE.labels)
def test_every_known_object_is_found_where_it_is(label: str, detector: str, size: tuple[int, int]) -> None:
    canvas = Canvas(*size)
    canvas.rectangle(label, beside(canvas, 0.1, 0.05), 0.8)
    detections = seen(canvas.frame(), detector=detector)
    assert [d.label for d in detections.detections] == [label]
    found = the(label, detections)
    assert (found.u_px, found.v_px) == pytest.approx(beside(canvas, 0.1, 0.05), abs=1.0)
    if detector == "blob":
        assert found.depth_m == pytest.approx(0.8, abs=0.01)


@DETECTORS
def test_an_empty_room_holds_nothing(detector: str) -> None:
    assert seen(Canvas().frame(), detector=detector).detections == ()


@SIZES
def test_the_box_and_the_area_are_those_of_the_object(size: tuple[int, int]) -> None:
    canvas = Canvas(*size)
    canvas.rectangle("red_can", middle(canvas), 1.0)
    found = the("red_can", seen(canvas.frame()))
    left, top, right, bottom = found.box_px
    painted_rows, painted_columns = np.nonzero((canvas.colour[:, :, 0] > 150) & (canvas.colour[:, :, 1] < 50))
    assert left == pytest.approx(painted_columns.min(), abs=1)
    assert top == pytest.approx(painted_rows.min(), abs=1)
    assert right == pytest.approx(painted_columns.max() + 1, abs=1)
    assert bottom == pytest.approx(painted_rows.max() + 1, abs=1)
    assert found.area_px == pytest.approx(len(painted_rows), rel=0.2)


@SIZES
@pytest.mark.parametrize("depth_m", [0.6, 0.75, 1.5, 3.0])
def test_depth_is_registered_to_the_colour_image(depth_m: float, size: tuple[int, int]) -> None:
    """The object is twice as wide as the shift of its depth: read at the colour's own pixels, half of it would be the
    wall's."""
    canvas = Canvas(*size)
    canvas.rectangle("yellow_ball", middle(canvas), depth_m)
    box = (0, 0, canvas.camera.width, canvas.camera.height)
    image = RgbdImage.of(canvas.frame(), ROBOT)
    depth = image.depth_m(box)
    yellow = canvas.colour[:, :, 2] < 60
    on_object = depth[yellow]
    assert np.isfinite(on_object).mean() > 0.9
    step_m = 5e-5 * (1 + (depth_m / 0.1236) ** 2)  # one step of the depth code
    assert np.abs(on_object[np.isfinite(on_object)] - depth_m).max() < step_m


def test_registering_a_part_of_the_image_gives_that_part_of_the_whole() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (200, 200), 0.9)
    canvas.rectangle("blue_can", (400, 300), 1.7)
    image = RgbdImage.of(canvas.frame(), ROBOT)
    whole = image.depth_m((0, 0, 640, 480))
    for left, top, right, bottom in ((150, 120, 260, 290), (380, 250, 640, 480), (0, 0, 30, 30)):
        part = image.depth_m((left, top, right, bottom))
        np.testing.assert_array_equal(part, whole[top:bottom, left:right])


# --- two regions of one colour --------------------------------------------------------------------


def can_and_patch() -> Canvas:
    canvas = Canvas()
    canvas.rectangle("red_can", (200, 240), 1.0)
    canvas.rectangle("red_can", (440, 240), 1.0, size_m=(0.08, 0.05))
    return canvas


def test_a_patch_of_the_cans_colour_does_not_pull_the_blob() -> None:
    found = the("red_can", seen(can_and_patch().frame()))
    assert (found.u_px, found.v_px) == pytest.approx((200, 240), abs=1.0)
    assert found.depth_m == pytest.approx(1.0, abs=0.01)


def test_the_papers_detector_points_between_two_regions_of_one_colour() -> None:
    """A known weakness of the paper's detector, which the default one does not share: the median of all matching
    pixels is on neither region."""
    canvas = Canvas()
    canvas.rectangle("red_can", (200, 100), 1.0)
    canvas.rectangle("red_can", (440, 380), 1.0, size_m=(0.065, 0.12))
    canvas.rectangle("red_can", (320, 240), 1.0, size_m=(0.012, 0.012))
    found = the("red_can", seen(canvas.frame(), detector="paper"))
    assert (found.u_px, found.v_px) == pytest.approx((320, 240), abs=5.0)
    better = the("red_can", seen(canvas.frame(), detector="blob"))
    assert min(abs(better.u_px - 200), abs(better.u_px - 440)) < 1.0


def test_a_larger_region_of_the_colour_is_not_preferred_to_one_of_the_right_size() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (440, 240), 1.6, size_m=(0.5, 0.5))
    canvas.rectangle("red_can", (150, 240), 1.6)
    found = the("red_can", seen(canvas.frame()))
    assert found.u_px == pytest.approx(150, abs=1.0)


@pytest.mark.parametrize("size_m", [(0.5, 0.5), (0.02, 0.03), (0.6, 0.03)], ids=["wall", "speck", "strip"])
def test_what_has_the_colour_but_no_objects_size_is_nothing(size_m: tuple[float, float]) -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (320, 240), 1.2, size_m=size_m)
    assert seen(canvas.frame()).detections == ()


def test_of_two_equal_objects_the_nearer_is_reported() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (200, 240), 1.6)
    canvas.rectangle("red_can", (440, 240), 1.0)
    assert the("red_can", seen(canvas.frame())).depth_m == pytest.approx(1.0, abs=0.01)


def test_a_can_before_a_wall_of_its_own_colour_is_told_from_it_by_depth() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (320, 240), 2.5, size_m=(1.0, 1.0))
    canvas.rectangle("red_can", (300, 240), 1.2)
    found = the("red_can", seen(canvas.frame()))
    assert found.u_px == pytest.approx(300, abs=2.0)
    assert found.depth_m == pytest.approx(1.2, abs=0.02)


def test_an_object_parted_in_two_by_a_bar_is_one_detection() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (320, 240), 1.0)
    top, bottom = 236, 246
    canvas.colour[top:bottom] = 90
    canvas.depth_m[top:bottom] = 0.8
    found = the("red_can", seen(canvas.frame()))
    assert found.v_px == pytest.approx(239.5, abs=2.0)
    assert found.box_px[3] - found.box_px[1] == pytest.approx(0.12 * canvas.camera.fy, abs=3)


# --- noise, depth, edges --------------------------------------------------------------------------


def test_single_wild_pixels_are_no_object() -> None:
    canvas = Canvas()
    draws = np.random.default_rng(1)
    wild = draws.random(canvas.depth_m.shape) < 0.02
    canvas.colour[wild] = (220, 10, 10)
    assert seen(canvas.frame()).detections == ()


@SIZES
def test_an_object_is_found_in_the_sensors_noise_and_drift(size: tuple[int, int]) -> None:
    draws = np.random.default_rng(2)
    for exposure, balance in ((0.9, 0.05), (1.1, -0.05), (1.1, 0.05), (0.9, -0.05)):
        canvas = Canvas(*size)
        for label, right in zip(CATALOGUE.labels, np.linspace(-0.4, 0.4, 6), strict=True):
            canvas.rectangle(label, beside(canvas, right), 0.9)
        gains = exposure * np.array([1 + balance, 1.0, 1 - balance])
        noisy = canvas.colour * gains + draws.normal(0, 4.0, canvas.colour.shape)
        canvas.colour = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        assert tuple(d.label for d in seen(canvas.frame()).detections) == CATALOGUE.labels


def test_colour_without_depth_is_refused_a_position() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (320, 240), None, seen_at_m=0.45)
    found = the("red_can", seen(canvas.frame()))
    assert found.depth_m is None
    assert found.position_m is None
    assert found.note == "no depth"
    assert found.u_px == pytest.approx(320, abs=1.0)


def test_what_the_depth_camera_sees_past_a_near_object_is_not_its_depth() -> None:
    """The depth camera is beside the colour camera, so it sees a strip of the wall that the can hides from the colour
    camera."""
    canvas = Canvas(wall_m=1.0)
    canvas.rectangle("red_can", (320, 240), None, seen_at_m=0.45)
    behind = RgbdImage.of(canvas.frame(), ROBOT).depth_m((278, 200, 362, 280))
    assert 0.15 < np.isfinite(behind).mean() < 0.4
    assert the("red_can", seen(canvas.frame())).note == "no depth"


def test_an_infrared_shadow_over_a_part_does_not_change_the_depth() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (320, 240), 1.0)
    canvas.depth_m[:, 300:335] = np.nan
    found = the("red_can", seen(canvas.frame()))
    assert found.depth_m == pytest.approx(1.0, abs=0.01)
    assert found.u_px == pytest.approx(320, abs=1.0)


def test_an_object_at_the_images_edge_is_noted_as_cut() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (0, 240), 1.0)
    found = the("red_can", seen(canvas.frame()))
    assert found.note == "cut"
    assert found.box_px[0] == 0
    assert found.position_m is not None


def test_at_the_right_edge_where_the_depth_camera_sees_past_an_object_no_position_is_claimed() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (640, 240), 1.0)
    assert all(found.position_m is None for found in seen(canvas.frame()).detections)


def test_an_object_that_is_mostly_hidden_is_noted_as_occluded() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (320, 240), 1.0)
    shift = round(canvas.camera.fx * 0.025 / 0.7)
    canvas.colour[:, 318:360] = 90
    canvas.depth_m[:, 318 + shift : 360 + shift] = 0.7
    found = the("red_can", seen(canvas.frame()))
    assert found.note == "occluded"
    assert found.position_m is not None


def test_the_same_small_patch_with_nothing_before_it_is_no_can() -> None:
    canvas = Canvas()
    canvas.rectangle("red_can", (310, 240), 1.0, size_m=(0.022, 0.12))
    assert seen(canvas.frame()).detections == ()


@DETECTORS
@pytest.mark.parametrize("size", [(1, 1), (3, 2), (17, 9), (160, 120), (641, 479)], ids=str)
def test_no_frame_however_odd_is_an_error(size: tuple[int, int], detector: str) -> None:
    draws = np.random.default_rng(7)
    width, height = size
    for trial in range(6):
        canvas = Canvas(*size)
        if trial == 0:
            canvas.colour = draws.integers(0, 256, (height, width, 3)).astype(np.uint8)
        else:
            for _ in range(8):
                left, top = draws.integers(0, width), draws.integers(0, height)
                known = CATALOGUE.objects[draws.integers(len(CATALOGUE))]
                canvas.colour[top : top + height // 3 + 1, left : left + width // 3 + 1] = np.array(known.rgb) * 200
        frame = canvas.frame()
        codes = draws.integers(0, 65536, height * width) if trial % 2 else np.full(height * width, 400 * trial)
        frame.depth = codes.astype("<u2").view(np.uint8).data
        found = seen(frame, 0.3, -0.6, detector=detector)
        assert msgspec.msgpack.decode(msgspec.msgpack.encode(found), type=Detections) == found


# --- the paper's detector, by its own rules -------------------------------------------------------


def paper(canvas: Canvas) -> list[str]:
    detector = PaperDetector(CATALOGUE, PerceptionConfig())
    return [sighting.label for sighting in detector.detect(RgbdImage.of(canvas.frame(), ROBOT))]


def painted(width: int, height: int, left: int = 20, top: int = 20) -> Canvas:
    canvas = Canvas()
    canvas.colour[top : top + height, left : left + width] = (200, 10, 12)
    return canvas


def test_the_paper_wants_more_than_64_pixels_in_one_tile() -> None:
    assert paper(painted(8, 8)) == []
    assert paper(painted(13, 5)) == ["red_can"]


def test_the_paper_counts_by_tile_not_by_image() -> None:
    across_four_tiles = painted(10, 10, left=123, top=91)
    assert paper(across_four_tiles) == []


def test_the_paper_reads_depth_at_the_same_pixel_unregistered() -> None:
    canvas = Canvas()
    canvas.rectangle("hand_marker", (320, 240), 0.6)
    canvas.depth_m[:] = 3.0
    shift = round(canvas.camera.fx * 0.025 / 0.6)
    canvas.depth_m[230:250, 320 + shift - 11 : 320 + shift + 11] = 0.6
    assert the("hand_marker", seen(canvas.frame(), detector="paper")).depth_m == pytest.approx(3.0, abs=0.03)
    assert the("hand_marker", seen(canvas.frame(), detector="blob")).depth_m == pytest.approx(0.6, abs=0.01)
