"""Measured values are put where they belong, and nothing else in the file changes."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from apps.cli.toml_files import with_values, write_values
from cocoro.errors import ConfigError
from cocoro.robot import Robot

FILE = """# Robbie's own.
name = "robbie"

[base]
wheel_separation_m = 0.2583   # measured with a ruler

# The elbow was mounted askew.
[[joint]]
name = "elbow"
centre_count = 500.0   # by hand

[[joint]]
name = "shoulder"
direction = -1
"""


def test_a_value_in_a_row_is_replaced_and_its_comment_stays() -> None:
    text = with_values(FILE, "joint", {"centre_count": 507.25, "direction": -1}, "elbow")
    assert "centre_count = 507.25   # by hand\ndirection = -1\n\n[[joint]]" in text
    assert "# The elbow was mounted askew." in text
    rows = {row["name"]: row for row in tomllib.loads(text)["joint"]}
    assert rows["elbow"]["direction"] == -1
    assert rows["shoulder"] == {"name": "shoulder", "direction": -1}


def test_a_new_row_and_a_new_table_come_at_the_end() -> None:
    text = with_values(FILE, "joint", {"limits_deg": (-120.0, 99.5)}, "neck_pan")
    text = with_values(text, "service.servos", {"arm_port": "/dev/ttyUSB0"})
    data = tomllib.loads(text)
    assert data["joint"][-1] == {"name": "neck_pan", "limits_deg": [-120.0, 99.5]}
    assert data["service"]["servos"]["arm_port"] == "/dev/ttyUSB0"
    assert text.startswith(FILE)


def test_a_table_is_changed_in_its_place() -> None:
    text = with_values(FILE, "base", {"wheel_separation_m": 0.26})
    assert "wheel_separation_m = 0.26   # measured with a ruler" in text
    assert text.count("wheel_separation_m") == 1


def test_an_empty_file_becomes_one_that_the_robot_can_be_loaded_with(tmp_path: Path) -> None:
    path = tmp_path / "new" / "measured.toml"
    write_values(path, "joint", {"centre_count": 530.0, "id": 15}, "elbow")
    robot = Robot.load(override=path)
    assert (robot.joints["elbow"].id, robot.joints["elbow"].centre_count) == (15, 530.0)


def test_a_file_that_is_no_toml_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "broken.toml"
    path.write_text("name = ")
    with pytest.raises(ConfigError, match=r"broken.toml is no good TOML"):
        write_values(path, "joint", {"id": 1}, "elbow")
    assert path.read_text() == "name = "
