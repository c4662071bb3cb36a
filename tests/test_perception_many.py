"""Perception looks at all objects of a frame at once; what it sees must be what it would see of each alone."""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from perception_scenes import CATALOGUE, ROBOT, Canvas, head_at

from cocoro.core import Sample
from cocoro.messages import Detection, Detections, Frame
from cocoro.objects import Catalogue
from cocoro.topics import FRAME
from services.perception.config import PerceptionConfig
from services.perception.core import PerceptionCore
from services.perception.evidence import middle_depths_m, surroundings
from services.perception.image import RgbdImage
from services.perception.region import ColourRegion
from services.perception.registration import Registration
from services.perception.segments import Segments, segments

AROUND = np.ones((3, 3), dtype=np.uint8)
TABLE = np.arange(65536, dtype=np.uint16).astype(np.uint8)
"""A layer's table where the colour's code is the label, so that a picture of labels can be given as one of colours."""
Region = tuple[int, int, tuple[int, int, int, int], frozenset[tuple[int, int]]]


def patches(size: tuple[int, int], seed: int, labels: int = 5) -> NDArray[np.uint16]:
    """Random patches of some labels, which touch one another and the picture's edges, with holes and specks, (height,
    width)."""
    draws = np.random.default_rng(seed)
    picture = np.zeros(size, dtype=np.uint16)
    for _ in range(25):
        height, width = draws.integers(1, max(size[0] // 3, 2)), draws.integers(1, max(size[1] // 3, 2))
        top, left = draws.integers(-3, size[0]), draws.integers(-3, size[1])
        picture[max(top, 0) : max(top + height, 0), max(left, 0) : max(left + width, 0)] = draws.integers(0, labels + 1)
    specks = draws.random(size) < 0.02
    picture[specks] = draws.integers(0, labels + 1, np.count_nonzero(specks))
    return picture


def one_by_one(picture: NDArray[np.uint16], min_area_px: float) -> set[Region]:
    """The regions of each label by OpenCV: opened in the whole picture, then its components."""
    found: set[Region] = set()
    for label in np.unique(picture[picture > 0]).tolist():
        opened = np.asarray(cv2.morphologyEx((picture == label).astype(np.uint8), cv2.MORPH_OPEN, AROUND))
        count, parts, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
        large = sorted((i for i in range(1, count) if stats[i, 4] >= min_area_px), key=lambda i: -stats[i, 4])
        for i in large[:8]:
            left, top, width, height, area = stats[i].tolist()
            pixels = frozenset((row, column) for row, column in np.argwhere(np.asarray(parts) == i).tolist())
            found.add((label - 1, area, (left, top, left + width, top + height), pixels))
    return found


def all_at_once(found: Segments | None, width: int) -> set[Region]:
    regions: set[Region] = set()
    if found is not None:
        for i, number in enumerate(found.number.tolist()):
            pixels = slice(found.start[i], found.start[i] + found.area_px[i])
            left, top, right, bottom = found.bounds[i].tolist()
            rows, columns = np.divmod(found.runs.at[pixels], width)
            at = frozenset(zip(rows.tolist(), columns.tolist(), strict=True))
            regions.add((number, int(found.area_px[i]), (left, top, right, bottom), at))
    return regions


@pytest.mark.parametrize("size", [(48, 64), (49, 65), (50, 66), (120, 160), (3, 3), (2, 5), (1, 1)], ids=str)
def test_the_regions_of_all_objects_are_those_of_each_one(size: tuple[int, int]) -> None:
    seen = 0
    for seed in range(25):
        picture = patches(size, seed)
        regions = all_at_once(segments(picture, TABLE, 0, 6.0), size[1])
        expected = one_by_one(picture, 6.0)
        assert {region[:3] for region in regions} == {region[:3] for region in expected}
        if len(expected) < 8:  # of more than eight the equal ones may be others
            assert regions == expected
        seen += len(expected)
    assert seen > 25 or min(size) < 4


def test_what_is_left_of_a_region_by_its_core_is_what_opening_left() -> None:
    found = segments(patches((120, 160), 3), TABLE, 0, 6.0)
    assert found is not None
    for region in range(len(found.start)):
        left, top, right, bottom = found.bounds[region].tolist()
        mask = found.mask(region, (left, top, right, bottom))
        pixels = slice(found.start[region], found.start[region] + found.area_px[region])
        core = np.zeros_like(mask)
        rows, columns = np.divmod(found.runs.at[pixels], 160)
        core[rows - top, columns - left] = found.core[pixels]
        np.testing.assert_array_equal(cv2.dilate(core, AROUND), mask)


# --- depth ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset_m", [-0.025, 0.025, 0.0])
def test_cameras_side_by_side_are_registered_as_any_others(offset_m: float) -> None:
    """The short way for cameras side by side against the general one."""
    draws = np.random.default_rng(2)
    depth_m = draws.uniform(0.5, 3.4, (24, 32)).repeat(5, axis=0).repeat(5, axis=1)
    depth_m[draws.random(depth_m.shape) < 0.05] = 99.0
    raw = ROBOT.depth_code(depth_m)
    way = Registration(ROBOT, 160, 120, (offset_m, 0.0, 0.0))
    for box in ((0, 0, 160, 120), (40, 20, 90, 70), (0, 100, 12, 120), (150, 0, 160, 30)):
        np.testing.assert_array_equal(way.codes(raw, box), way.codes_generally(raw, box))


@pytest.mark.parametrize("offset_m", [(-0.025, 0.0, 0.0), (0.025, 0.0, 0.0), (-0.02, 0.01, 0.0)], ids=str)
def test_boxes_that_overlap_are_registered_as_the_whole_image(offset_m: tuple[float, float, float]) -> None:
    draws = np.random.default_rng(3)
    depth_m = draws.uniform(0.5, 3.4, (24, 32)).repeat(5, axis=0).repeat(5, axis=1)
    raw = ROBOT.depth_code(depth_m)
    way = Registration(ROBOT, 160, 120, offset_m)
    whole = way.codes(raw, (0, 0, 160, 120))
    for _ in range(20):
        first = draws.integers(0, (150, 110), (12, 2))
        boxes = np.concatenate([first, np.minimum(first + draws.integers(1, 60, (12, 2)), (160, 120))], axis=1)
        some = way.codes_in_boxes(raw, boxes)
        for left, top, right, bottom in boxes.tolist():
            np.testing.assert_array_equal(some[top:bottom, left:right], whole[top:bottom, left:right])


def canvas_of_all(seed: int, size: tuple[int, int] = (640, 480)) -> Canvas:
    """All known objects side by side, at random depths, with noise; the blue ones at the sides."""
    draws = np.random.default_rng(seed)
    canvas = Canvas(*size)
    places = draws.permutation(np.linspace(0.08, 0.92, len(CATALOGUE)))
    for label, right in zip(CATALOGUE.labels, places, strict=True):
        centre = right * size[0], draws.uniform(0.3, 0.7) * size[1]
        canvas.rectangle(label, centre, draws.uniform(0.9, 1.6))
    noisy = canvas.colour + draws.normal(0, 4.0, canvas.colour.shape)
    canvas.colour = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return canvas


def test_a_regions_depth_is_the_same_alone_as_among_others() -> None:
    for seed in range(4):
        image = RgbdImage.of(canvas_of_all(seed).frame(), ROBOT)
        labels = np.zeros((480, 640), dtype=np.uint16)
        for number in range(12):
            labels[20 + 35 * number : 20 + 35 * number + 30, 40 * number : 40 * number + 6 + 5 * number] = 1 + number
        found = segments(labels, TABLE, 0, 6.0)
        assert found is not None
        image.register(np.array([(0, 0, 640, 480)]))
        depths = middle_depths_m(found, image)
        for region, depth_m in enumerate(depths.tolist()):
            left, top, right, bottom = found.bounds[region].tolist()
            box = image.clip((left, top, right, bottom), ColourRegion.margin_px(image))
            alone = ColourRegion(found.mask(region, box), box, image).depth_m
            assert alone == pytest.approx(depth_m, abs=1e-7) or (alone is None and depth_m != depth_m)


def test_the_pixels_around_many_regions_are_those_around_each() -> None:
    image = RgbdImage.of(canvas_of_all(1).frame(), ROBOT)
    image.register(np.array([(0, 0, 640, 480)]))
    for seed in range(4):
        picture = np.zeros((480, 640), dtype=np.uint16)
        picture[:240, 320 * (seed % 2) : 320 * (seed % 2) + 320] = patches((240, 320), seed, labels=30)
        found = segments(picture, TABLE, 0, 6.0)
        assert found is not None
        at, _, first, counts = surroundings(found, image)
        for region in range(len(found.number)):
            left, top, right, bottom = found.bounds[region].tolist()
            box = image.clip((left, top, right, bottom), ColourRegion.margin_px(image))
            alone = ColourRegion(found.mask(region, box), box, image)
            rows, columns = np.nonzero(alone.surroundings & np.isfinite(alone.depth))
            expected = (rows + box[1]) * 640 + columns + box[0]
            np.testing.assert_array_equal(at[first[region] : first[region] + counts[region]], expected)


# --- the whole detector ---------------------------------------------------------------------------


def detections(frame: Frame, catalogue: Catalogue, tilt: float = -0.3) -> dict[str, Detection]:
    core = PerceptionCore(ROBOT, PerceptionConfig(), catalogue)
    around = [head_at(frame.stamp_ns + offset_ns, 0.1, tilt) for offset_ns in (-10_000_000, 10_000_000)]
    message = core.step([*around, Sample(FRAME, frame)], frame.stamp_ns + 20_000_000)[0].message
    assert isinstance(message, Detections)
    return {one.label: one for one in message.detections}


@pytest.mark.parametrize("size", [(640, 480), (320, 240)], ids=["640x480", "320x240"])
def test_an_object_among_others_is_detected_as_it_is_alone(size: tuple[int, int]) -> None:
    for seed in range(4):
        frame = canvas_of_all(seed, size).frame()
        together = detections(frame, CATALOGUE)
        assert set(together) == set(CATALOGUE.labels)
        for known in CATALOGUE:
            alone = detections(frame, Catalogue((known,)))[known.label]
            seen = together[known.label]
            if alone.box_px != seen.box_px and known.lab_by_shape:
                continue  # alone it is also sought in the other blue thing
            assert (seen.u_px, seen.v_px, seen.area_px) == (alone.u_px, alone.v_px, alone.area_px)
            assert (seen.depth_m, seen.note) == (alone.depth_m, alone.note)
            assert seen.position_m == pytest.approx(alone.position_m, abs=2e-4)


def test_an_object_that_fills_the_whole_picture_has_no_outline_and_is_still_placed() -> None:
    canvas = Canvas(wall_m=1.0)
    canvas.colour[:] = np.round(200 * np.array(CATALOGUE["red_can"].rgb))
    big = msgspec.structs.replace(CATALOGUE["red_can"], label="wall", radius_m=0.9, height_m=1.6)
    found = detections(canvas.frame(), Catalogue((big,)), tilt=0.3)["wall"]
    assert found.box_px == (0, 0, 640, 480)
    assert found.depth_m == pytest.approx(1.0, abs=0.01)
    assert found.position_m is not None


@pytest.mark.parametrize("depth_m", [2.0, 2.5, 3.0])
def test_in_a_small_picture_what_is_two_pixels_wide_is_still_seen(depth_m: float) -> None:
    canvas = Canvas(160, 120)
    canvas.rectangle("red_can", (80, 60), depth_m)
    left, _, right, _ = detections(canvas.frame(), CATALOGUE)["red_can"].box_px
    assert right - left == 2
