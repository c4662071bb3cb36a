"""The cameras of a robot description: rows, former forms, what a robot without depth does with depth codes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bodies import DESCRIPTION

from cocoro.errors import ConfigError
from cocoro.learning.handmap import fingerprint_of
from cocoro.messages import Frame
from cocoro.robot import Robot
from services.frames.packing import pack, unpack

CAMERA = DESCRIPTION[DESCRIPTION.index("[[camera]]") : DESCRIPTION.index("[head]")]
FORMER = CAMERA.replace("[[camera]]\n", "[kinect]\n").replace('name = "kinect"\n', "")
FORMER = FORMER.replace('depth = "kinect" ', "# ")
SECOND = """
[[camera]]
name = "wrist"
link = "wrist_roll"
width = 320
height = 240
rate_hz = 15.0
horizontal_fov_rad = 1.0
vertical_fov_rad = 0.8
"""


def loaded(tmp_path: Path, text: str, own: str = "") -> Robot:
    """The robot of a description, with a robot's own file."""
    file, measured = tmp_path / "robot.toml", tmp_path / "own.toml"
    file.write_text(text, encoding="utf-8")
    measured.write_text(own, encoding="utf-8")
    return Robot.load(file, measured)


def test_the_former_table_is_the_same_camera(robot: Robot, tmp_path: Path) -> None:
    assert "[kinect]\nlink" in FORMER
    assert loaded(tmp_path, DESCRIPTION.replace(CAMERA, FORMER)).to_data() == robot.to_data()


def test_a_capture_of_before_still_opens_with_its_fingerprint(robot: Robot) -> None:
    """The fingerprint was taken when a description had one table [kinect]."""
    data = robot.to_data()
    row = data.pop("camera")[0]
    data.pop("eye")
    assert row.pop("depth") == "kinect"
    assert row.pop("name") == "kinect"
    again = Robot.from_data({**data, "kinect": row})
    assert again.to_data() == robot.to_data()
    assert fingerprint_of(again) == fingerprint_of(robot) == "79aad3ba69aa79c3"


@pytest.mark.parametrize(
    "own",
    [
        "[kinect]\nrate_hz = 12.0\n",
        "[camera]\nrate_hz = 12.0\n",
        '[[camera]]\nname = "kinect"\nrate_hz = 12.0\n',
        '[kinect]\nrate_hz = 5.0\n\n[[camera]]\nname = "kinect"\nrate_hz = 12.0\n',
    ],
)
def test_a_robots_own_file_changes_the_camera_that_it_finds_things_by(robot: Robot, tmp_path: Path, own: str) -> None:
    changed = loaded(tmp_path, DESCRIPTION + SECOND, own)
    assert (changed.eye.name, changed.eye.rate_hz, changed.eye.width) == ("kinect", 12.0, robot.eye.width)
    assert changed.cameras["wrist"].rate_hz == 15.0
    assert changed.cameras["wrist"].depth == "none"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ('eye = "nose"\n' + DESCRIPTION, "eye: there is no camera 'nose'; there are kinect"),
        (DESCRIPTION + SECOND.replace('"wrist_roll"', '"nowhere"'), "camera wrist: link: there is no link 'nowhere'"),
        (DESCRIPTION + SECOND.replace('"wrist"', '"kinect"'), "camera: 'kinect' is the name of two"),
        ('eye = "wrist"\n' + DESCRIPTION + SECOND, r"camera: the joint '\w+' turns it, which is none of the head's"),
        (DESCRIPTION.replace('depth = "kinect" ', 'depth = "mm" '), "depth_curve belongs to depth = 'kinect'"),
        ('based_on = "callipe"\nname = "x"\n', "did you mean calliope"),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path: Path, text: str, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        loaded(tmp_path, text)


def test_a_shipped_description_is_another_one_with_few_changes() -> None:
    colour, whole = Robot.load(Path("lekiwi-colour")), Robot.load(Path("lekiwi"))
    assert (colour.eye.name, colour.sees_depth, whole.eye.name, whole.sees_depth) == (
        "webcam", False, "depth_camera", True,
    )  # fmt: skip
    assert colour.to_data() | {"eye": ""} == whole.to_data()


def test_millimetres_are_depth_codes(robot: Robot) -> None:
    whole = Robot.load(Path("lekiwi"))
    metres = np.array([0.2, 0.3, 1.2344, 2.9, 3.1, np.inf])
    codes = whole.depth_code(metres)
    assert codes.tolist() == [65535, 300, 1234, 2900, 65535, 65535]
    np.testing.assert_allclose(whole.depth_m(codes), [np.nan, 0.3, 1.234, 2.9, np.nan, np.nan], rtol=1e-6)
    assert (np.diff(whole.depth_m(np.arange(6000, dtype=np.uint16))) >= 0).all(), "codes rise with the depth"
    assert robot.depth_code(metres).max() == 2047


def test_without_depth_no_code_has_a_depth() -> None:
    colour = Robot.load(Path("lekiwi-colour"))
    assert np.isnan(colour.depth_m(np.array([0, 500, 2047, 65535], dtype=np.uint16))).all()


def frame(depth: bytes) -> Frame:
    return Frame(width=4, height=4, colour=memoryview(bytes(48)), depth=memoryview(depth))


def test_a_frame_has_depth_for_every_pixel_or_none() -> None:
    assert frame(bytes(32)).has_depth
    assert not frame(b"").has_depth
    with pytest.raises(ValueError, match="depth has 30 bytes"):
        frame(bytes(30))


@pytest.mark.parametrize("divisor", [1, 2])
def test_a_frame_without_depth_is_packed_and_unpacked(divisor: int) -> None:
    packed = pack(frame(b""), divisor)
    again = unpack(packed)
    assert (packed.depth, again.has_depth, again.width) == (b"", False, 4 // divisor)
