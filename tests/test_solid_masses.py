"""Parts without a mass: fixed on the body they weigh nothing, and on a link that turns they are refused."""

from __future__ import annotations

import numpy as np
import pytest

from cocoro.errors import ConfigError
from cocoro.robot import Robot
from sim.model import build_model
from sim.random_scene import find_scene
from sim.world import World

BOX = {"name": "lid", "link": "body", "shape": "box", "size_m": [0.05, 0.05, 0.02], "position_m": [-0.05, 0.0, 0.3]}


def with_lid() -> Robot:
    data = Robot.load().to_data()
    data["solid"]["part"].append(BOX)
    return Robot.from_data(data)


def test_the_model_has_numbers_for_a_part_of_the_body_without_mass() -> None:
    model = build_model(with_lid())
    assert "lid" in model.links
    assert "nan" not in model.urdf


@pytest.mark.sim
def test_the_world_runs_with_a_part_of_the_body_without_mass() -> None:
    with World(with_lid(), find_scene("paper", 0)) as world:
        start = world.link_pose("body")
        for _ in range(240):
            world.step()
        assert np.linalg.norm(world.link_pose("body")[:3, 3] - start[:3, 3]) < 0.002


@pytest.mark.parametrize("joint", ["elbow", "neck_pan"])
def test_a_link_that_turns_and_has_no_mass_is_refused(joint: str) -> None:
    data = Robot.load().to_data()
    parents = {row["name"]: row for row in data["link"]}
    for part in data["solid"]["part"]:
        link = part["link"]
        while link in parents and parents[link]["joint"] is None:
            link = parents[link]["parent"]
        if link == joint:
            part["mass_kg"] = 0.0
    with pytest.raises(
        ConfigError, match=f"the joint '{joint}' turns the link '{joint}', and no part there has a mass"
    ):
        Robot.from_data(data)
