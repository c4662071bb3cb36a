"""The page of the LeKiwi's numbers agrees with itself: its rows lead to the places that its tables have."""

from __future__ import annotations

import re
import tomllib
from math import radians
from pathlib import Path

import pytest

from cocoro.kinematics import Link, Origin, Tree

PAGE = (Path(__file__).parent.parent / "docs" / "robots" / "lekiwi-numbers.md").read_text(encoding="utf-8")
ROWS = [row for block in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL) for row in tomllib.loads(block)["link"]]


def table(heading: str) -> dict[str, list[str]]:
    """The cells of a table by the first one of each row."""
    rows = PAGE[PAGE.index(f"| {heading} |") :].split("\n\n")[0].splitlines()[2:]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    return {first: rest for first, *rest in cells}


def links() -> dict[str, Link]:
    found = {}
    for row in ROWS:
        roll, pitch, yaw = (radians(angle) for angle in row["rpy_deg"])
        place = Origin(tuple(row["xyz_m"]), (roll, pitch, yaw))
        found[row["name"]] = Link(row["name"], row["parent"], row.get("joint"), place)
    return found


def test_the_rows_of_the_arm_lead_to_the_places_of_the_published_urdf() -> None:
    places = table("frame")
    tree = Tree(links(), places, root="base_link")
    poses = tree.poses({row["joint"]: 0.0 for row in ROWS if "joint" in row})
    assert len(places) == 7
    for name, (text,) in places.items():
        assert poses[name][:3, 3] == pytest.approx([float(word) for word in text.split(",")], abs=1e-5), name
    assert poses["gripper_frame_link"][:3, 2] == pytest.approx([1, 0, 0], abs=1e-5)


def test_the_arm_stands_with_its_pan_axis_where_the_drawing_has_it() -> None:
    pan = Tree(links(), ["shoulder_link"]).poses({"shoulder_pan": 0.0})["shoulder_link"]
    assert pan[:2, 3] == pytest.approx([0.0672, 0.0], abs=1e-4)
    assert pan[2, 3] == pytest.approx(0.05 - 0.0179 + 0.057 + 0.0024 + 0.0624, abs=1e-4)


def test_masses_of_the_arm_add_up() -> None:
    moved = [float(cells[2]) for cells in table("joint").values()]
    assert sum(moved) + 0.147 == pytest.approx(0.632, abs=5e-4)


def test_each_wheel_drives_at_a_right_angle_to_its_bearing() -> None:
    for _, bearing, drive, _ in table("wheel").values():
        assert (float(drive.split()[0]) - float(bearing.split()[0])) % 360.0 == 90.0
