"""Calibration from views of a chessboard by a Kinect with known parameters, and rectification with the result."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from chessboard import Eyes, Painter, lying

from apps.cli import kinect as command
from apps.cli.toml_files import write_values
from cocoro.arrays import FloatArray
from cocoro.errors import CocoroError, ConfigError
from cocoro.robot import Robot
from services.kinect import tools
from services.kinect.calibration import Board, BoardView, Calibration, calibrate, find_corners
from services.kinect.device import RawFrame
from services.kinect.lens import Lens, Straightener

BOARD = Board(8, 6, 0.04)
EYES = Eyes(
    colour=(527.0, 525.5, 322.0, 252.0, 0.18, -0.35, 0.001, -0.001, 0.0),
    depth=(589.0, 587.0, 331.0, 236.0, -0.05, 0.08, 0.0, 0.0, 0.0),
    turn_rad=(0.004, -0.006, 0.003),
    place_m=(-0.0252, 0.0004, -0.0012),
    curve=(0.1236, 2800.0, 1.1845),
)
VIEWS = 20
CORNER_PX = 0.08
"""Error of a found corner."""


def held(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A board anywhere in the colour image, tilted in any direction, completely visible."""
    while True:
        away_m = rng.uniform(0.55, 1.3)
        turn = (rng.uniform(-0.7, 0.7), rng.uniform(-0.7, 0.7), rng.uniform(-0.3, 0.3))
        place = (rng.uniform(-0.4, 0.4) * away_m, rng.uniform(-0.3, 0.3) * away_m, away_m)
        rotation, origin = lying(turn, place, BOARD)
        corners = corners_of(rotation, origin)
        if (corners > 5).all() and (corners < [634, 474]).all():
            return rotation, origin


def corners_of(rotation: FloatArray, origin: FloatArray) -> FloatArray:
    return Lens(EYES.colour).pixels(BOARD.points_m.astype(float) @ rotation.T + origin)


@pytest.fixture(scope="module")
def painter() -> Painter:
    return Painter(EYES, BOARD)


@pytest.fixture(scope="module")
def views(painter: Painter) -> list[BoardView]:
    rng = np.random.default_rng(3)
    boards = [held(rng) for _ in range(VIEWS)]
    return [
        BoardView(corners_of(*board) + rng.normal(0.0, CORNER_PX, (len(BOARD.points_m), 2)), painter.depth(*board))
        for board in boards
    ]


@pytest.fixture(scope="module")
def found(views: list[BoardView]) -> Calibration:
    return calibrate(views, BOARD, Robot.load())


def test_the_figures_come_out_as_they_are(found: Calibration) -> None:
    assert found.colour_lens[:2] == pytest.approx(EYES.colour[:2], rel=0.004)
    assert found.colour_lens[2:4] == pytest.approx(EYES.colour[2:4], abs=1.5)
    assert found.colour_misfit_px == pytest.approx(CORNER_PX * 2**0.5, rel=0.2)
    assert found.depth_misfit_codes == pytest.approx(0.75, abs=0.15)  # the noise, and the rounding
    for place_m, true_m, doubt_m in zip(found.depth_offset_m, EYES.place_m, found.offset_doubt_m, strict=True):
        assert doubt_m < 0.0015
        assert abs(place_m - true_m) < 0.003


def test_depth_and_colour_are_brought_together_within_half_a_pixel_and_one_step(found: Calibration) -> None:
    """Errors over the robot's working range: points at 0.6 to 2 m, through the true Kinect and back by the
    calibration."""
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.45, 0.45, 2000), rng.uniform(-0.33, 0.33, 2000), np.ones(2000)])
    true_m = rays * rng.uniform(0.6, 2.0, (2000, 1))
    seen_m = (true_m - EYES.place_m) @ EYES.turn
    a, b, c = found.depth_curve
    depth_m = a * np.tan(EYES.code(seen_m[:, 2]) / b + c)
    turn = np.asarray(cv2.Rodrigues(np.array(found.depth_rotation_rad))[0], float)
    back_m = (Lens(found.depth_lens).rays(Lens(EYES.depth).pixels(seen_m)) * depth_m[:, None]) @ turn.T
    back_m += found.depth_offset_m
    off_px = np.linalg.norm(Lens(found.colour_lens).pixels(back_m) - Lens(EYES.colour).pixels(true_m), axis=1)
    assert np.percentile(off_px, 95) < 1.0
    assert np.median(off_px) < 0.5
    step_m = a / b * (1.0 + (true_m[:, 2] / a) ** 2)
    assert np.percentile(np.abs(back_m[:, 2] - true_m[:, 2]) / step_m, 95) < 1.0


def test_what_was_written_into_the_robots_file_straightens_its_pictures(
    found: Calibration, painter: Painter, tmp_path: Path
) -> None:
    file = tmp_path / "measured.toml"
    write_values(file, "camera", found.values(), "kinect")
    robot = Robot.load(None, file)
    rotation, origin = lying((0.3, -0.4, 0.1), (0.1, 0.05, 0.9), BOARD)
    shot = RawFrame(7, painter.colour(rotation, origin), painter.depth(rotation, origin))
    straightener = Straightener(robot)
    assert not straightener.idle
    straight = straightener(shot)
    assert straight.stamp_ns == 7

    corners = find_corners(straight.colour, BOARD)
    assert corners is not None
    points_m = BOARD.points_m.astype(float) @ rotation.T + origin
    wanted = Lens.of(robot.camera).pixels(points_m)
    off_px = min(np.linalg.norm(order - wanted, axis=1).max() for order in (corners, corners[::-1]))
    assert off_px < 1.0
    # As readers of frames assume: a pinhole beside the colour camera that looks in the same direction.
    beside_m = points_m - robot.eye.depth_offset_m
    u, v = np.rint(Lens.of(robot.camera).pixels(beside_m)).astype(int).T
    assert straight.depth is not None
    depth_m = robot.depth_m(straight.depth)[v, u]
    a, b, _ = robot.eye.curve
    step_m = a / b * (1.0 + (beside_m[:, 2] / a) ** 2)
    assert np.median(np.abs(depth_m - beside_m[:, 2]) / step_m) < 1.0


def test_pictures_of_a_kinect_that_was_not_measured_are_passed_on_as_they_are() -> None:
    straightener = Straightener(Robot.load())
    assert straightener.idle
    shot = RawFrame(0, np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.uint16))
    assert straightener(shot).depth is shot.depth
    assert straightener(shot).colour is shot.colour


def test_too_few_views_and_a_board_of_another_size_are_said(views: list[BoardView]) -> None:
    with pytest.raises(CocoroError, match="visible in 5 views; at least 6 are needed"):
        calibrate(views[:5], BOARD, Robot.load())
    with pytest.raises(CocoroError, match="the board has depth in 0 views; at least 6 are needed"):
        calibrate(views[:6], Board(8, 6, 0.05), Robot.load())
    rng = np.random.default_rng(5)
    bent = [BoardView(view.corners_px + rng.normal(0.0, 2.0, view.corners_px.shape), view.depth) for view in views[:6]]
    with pytest.raises(CocoroError, match=r"the corners miss a flat board's by .* is it 8 x 6 inner corners"):
        calibrate(bent, BOARD, Robot.load())


def test_a_view_is_taken_when_the_board_is_held_still_somewhere_new(painter: Painter, tmp_path: Path) -> None:
    collector = tools.ViewCollector(BOARD, tmp_path)
    places = [lying((0.2, 0.3, 0.0), (x, 0.0, 0.8), BOARD) for x in (-0.1, 0.05)]
    shots = [RawFrame(0, painter.colour(*place), painter.depth(*place)) for place in places]
    nothing = RawFrame(0, np.full((480, 640, 3), 90, np.uint8), shots[0].depth)
    assert collector.take(nothing) == "the board is not seen whole"
    assert collector.take(shots[0]) == "hold it still"
    told = [collector.take(shots[0]) for _ in range(tools.STILL_FRAMES)]
    assert told == [""] * (tools.STILL_FRAMES - 1) + ["view 1"]
    assert collector.take(shots[0]) == "now move it elsewhere, or tilt it another way"
    assert collector.take(shots[1]) == "hold it still"
    told += [collector.take(shots[1]) for _ in range(tools.STILL_FRAMES)]
    assert told[-1] == "view 2"

    read = tools.read(tmp_path, BOARD, told.append)
    assert [view.depth.tobytes() for view in read] == [view.depth.tobytes() for view in collector.views]
    assert np.allclose(read[0].corners_px, collector.views[0].corners_px)
    whole = corners_of(*places[0])
    assert min(np.abs(read[0].corners_px - order).max() for order in (whole, whole[::-1])) < 0.5


def test_the_command_calibrates_from_kept_views_and_writes_the_robots_file(
    painter: Painter, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(4)
    for number in range(1, 8):
        board = held(rng)
        tools.save(tmp_path, number, painter.colour(*board), painter.depth(*board))
    assert command.calibrate_from_views("robot", "8x6", 40.0, 30, tmp_path, None, None) == 0
    out = capsys.readouterr().out
    assert "7 views" in out
    assert 'measured = "calliope-measured.toml"' in out
    kinect = Robot.load(None, tmp_path / "calliope-measured.toml").eye
    assert kinect.colour_lens is not None
    assert kinect.colour_lens[0] == pytest.approx(EYES.colour[0], rel=0.02)
    assert kinect.depth_lens is not None
    with pytest.raises(ConfigError, match="inner corners as 9x6"):
        command.calibrate_from_views("robot", "8 by 6", 40.0, 30, tmp_path, None, None)
    with pytest.raises(ConfigError, match="side of a square in mm"):
        command.calibrate_from_views("robot", "8x6", 0.04, 30, tmp_path, None, None)
    with pytest.raises(ConfigError, match="holds views already"):
        command.calibrate_from_views("robot", "8x6", 40.0, 30, None, tmp_path, None)


def test_depths_of_a_still_view_are_their_middle_and_none_where_one_is_missing() -> None:
    depths = [np.array([[700, 701]], np.uint16), np.array([[704, 2047]], np.uint16), np.array([[702, 701]], np.uint16)]
    assert tools.median_depth(depths).tolist() == [[702, 2047]]


def test_a_folder_without_views_and_one_with_half_a_view_are_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds no views"):
        tools.read(tmp_path, BOARD, print)
    tools.save(tmp_path, 1, np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.uint16))
    (tmp_path / "view-01-depth.png").unlink()
    with pytest.raises(ConfigError, match=r"view-01-depth.png are not a view"):
        tools.read(tmp_path, BOARD, print)
