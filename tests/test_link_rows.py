"""The two forms of a link's row: by Denavit and Hartenberg, and by origin and roll, pitch, yaw as in a URDF."""

from __future__ import annotations

import re
from math import degrees
from typing import Any

import numpy as np
import pytest

from cocoro.errors import ConfigError
from cocoro.kinematics import Origin, Tree
from cocoro.learning.handmap import NominalModel, fingerprint_of
from cocoro.link_row import DENAVIT_HARTENBERG
from cocoro.robot import Robot
from sim.model import build_model
from sim.realism import body_of

ROBOT = Robot.load()


def by_origins() -> dict[str, Any]:
    """The Calliope with each row in the other form."""
    data = ROBOT.to_data()
    for row in data["link"]:
        fixed = ROBOT.links[row["name"]].fixed()
        for field in DENAVIT_HARTENBERG:
            del row[field]
        place = Origin.of(fixed)
        row |= {"xyz_m": place.xyz_m, "rpy_deg": tuple(degrees(angle) for angle in place.rpy_rad)}
    return data


def test_rows_of_the_other_form_put_every_link_in_the_same_place() -> None:
    other = Robot.from_data(by_origins())
    rng = np.random.default_rng(1)
    for _ in range(20):
        angles = dict(zip(ROBOT.joints, rng.uniform(-2.6, 2.6, len(ROBOT.joints)).tolist(), strict=True))
        here, there = (Tree(robot.links, robot.links).poses(angles) for robot in (ROBOT, other))
        assert here.keys() == there.keys()
        for name, pose in here.items():
            assert there[name] == pytest.approx(pose, abs=1e-12)


def test_models_of_the_arm_and_of_the_simulator_work_with_either_form() -> None:
    other = Robot.from_data(by_origins())
    one, two = NominalModel(ROBOT), NominalModel(other)
    postures, places = one.priming(4)
    assert two.predict(postures) == pytest.approx(places, abs=1e-12)
    assert two.jacobian(postures[7]) == pytest.approx(one.jacobian(postures[7]), abs=1e-12)
    carried = build_model(other).carried
    for name, (carrier, pose) in build_model(ROBOT).carried.items():
        assert carried[name][0] == carrier
        assert carried[name][1] == pytest.approx(pose, abs=1e-12)


def test_a_body_of_either_form_wears_by_millimetres() -> None:
    other = Robot.from_data(by_origins())
    worn = body_of(other, "worn", seed=1).robot
    moved = {name: worn.links[name].fixed()[:3, 3] - link.fixed()[:3, 3] for name, link in other.links.items()}
    assert all(np.abs(shift).max() <= 0.005 for shift in moved.values())
    assert all(moved[other.link_of(joint)].any() for joint in (*other.arm.joints, other.arm.roll))


def test_a_row_is_the_data_that_it_was_read_from_whatever_forms_there_are() -> None:
    rows = ROBOT.to_data()["link"]
    assert all(list(row) == ["name", "parent", *DENAVIT_HARTENBERG, "joint", "offset_deg"] for row in rows)
    assert fingerprint_of(ROBOT) != fingerprint_of(Robot.from_data(by_origins()))
    again = Robot.from_data(Robot.from_data(by_origins()).to_data())
    assert again.to_data()["link"] == by_origins()["link"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"xyz_m": [0, 0, 0]}, "link elbow: theta_deg, d_m, alpha_deg, r_m, xyz_m do not go together; a link needs"),
        ({"rpy_deg": [0, 0, 0]}, "link elbow: theta_deg, d_m, alpha_deg, r_m, rpy_deg do not go together"),
        ({"theta_deg": None, "r_m": None}, "link elbow: theta_deg and r_m missing; a link needs theta_deg, d_m"),
        (dict.fromkeys(DENAVIT_HARTENBERG), "link elbow: its place is missing; a link needs theta_deg"),
        (dict.fromkeys(DENAVIT_HARTENBERG) | {"xyz_m": [0, 0, 0]}, "link elbow: rpy_deg missing; a link needs"),
        (dict.fromkeys(DENAVIT_HARTENBERG) | {"xyz_m": [0, 0], "rpy_deg": [0, 0, 0]}, "length 3"),
    ],
)
def test_a_row_of_both_forms_of_none_or_of_half_a_form_is_refused(change: dict[str, Any], says: str) -> None:
    data = ROBOT.to_data()
    row = next(row for row in data["link"] if row["name"] == "elbow")
    for field, value in change.items():
        if value is None:
            del row[field]
        else:
            row[field] = value
    with pytest.raises(ConfigError, match=re.escape(says)):
        Robot.from_data(data)
