"""Frames as pictures for people."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from perception_scenes import CATALOGUE, Canvas, seen

from apps.pictures import captioned, colour_of, describe, draw, save_png
from cocoro.errors import CocoroError
from cocoro.messages import Detection, Detections, Frame


def scene() -> Frame:
    canvas = Canvas()
    canvas.rectangle("red_can", (320, 240), 1.0)
    return canvas.frame()


def test_each_detection_is_boxed_and_the_frame_itself_is_left_alone() -> None:
    frame = scene()
    before = colour_of(frame).copy()
    image = draw(frame, seen(frame), CATALOGUE)
    left, top, right, bottom = seen(frame).detections[0].box_px
    changed = np.nonzero((image != before).any(axis=2))
    assert changed[1].min() == pytest.approx(left - 3, abs=2)
    assert changed[0].max() == pytest.approx(bottom + 2, abs=2)
    assert changed[0].min() < top - 10  # the text above
    assert changed[1].max() > right
    np.testing.assert_array_equal(colour_of(frame), before)


def test_without_detections_it_is_the_frame() -> None:
    np.testing.assert_array_equal(draw(scene()), colour_of(scene()))


def test_a_caption_is_written_at_the_bottom() -> None:
    image = draw(scene())
    captioned(image, "at the grasp")
    changed = np.nonzero((image != draw(scene())).any(axis=2))
    assert changed[0].min() > 440


def test_text_stays_within_the_picture_at_any_edge() -> None:
    corners = [(0, 0, 20, 20), (620, 0, 640, 20), (0, 460, 20, 480), (620, 460, 640, 480)]
    found = tuple(
        Detection(label="yellow_ball", u_px=left + 10, v_px=top + 10, area_px=400, box_px=(left, top, right, bottom))
        for left, top, right, bottom in corners
    )
    message = Detections(frame_seq=0, frame_incarnation=0, width=640, height=480, detections=found)
    assert draw(scene(), message).shape == (480, 640, 3)


def test_detections_of_another_resolution_are_drawn_to_scale() -> None:
    small = Canvas(320, 240)
    small.rectangle("red_can", (160, 120), 1.0)
    image = draw(scene(), seen(small.frame()), CATALOGUE)
    columns = np.nonzero((image != colour_of(scene())).any(axis=2))[1]
    assert columns.min() > 270


@pytest.mark.parametrize(
    ("position_m", "note", "text"),
    [
        ((3.0, 4.0, 0.1), "", "red_can 5.00 m"),
        ((0.6, 0.0, 0.1), "occluded", "red_can 0.60 m (occluded)"),
        (None, "no depth", "red_can (no depth)"),
    ],
)
def test_the_words_say_the_level_distance_and_the_doubt(
    position_m: tuple[float, float, float] | None, note: str, text: str
) -> None:
    detection = Detection(
        label="red_can", u_px=1, v_px=1, area_px=1, box_px=(0, 0, 2, 2), position_m=position_m, note=note
    )
    assert describe(detection) == text


def test_a_saved_picture_has_the_pixels_in_the_right_order_and_makes_its_folder(tmp_path: Path) -> None:
    path = tmp_path / "out" / "seen.png"
    image = draw(scene(), seen(scene()), CATALOGUE)
    save_png(image, path)
    read = cv2.imread(str(path))
    assert read is not None
    np.testing.assert_array_equal(read[:, :, ::-1], image)


def test_a_picture_that_cannot_be_written_says_where(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(CocoroError, match=r"file.seen\.png"):
        save_png(draw(scene()), blocked / "seen.png")
