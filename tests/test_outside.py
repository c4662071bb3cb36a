"""The simulated world as an onlooker sees it: what stands where, by the published truth."""

from __future__ import annotations

import numpy as np
import pytest

from cocoro.errors import ConfigError
from cocoro.messages import ServoCommand
from cocoro.robot import Robot
from sim.outside import OutsideStage, stage_of
from sim.realism import body_of
from sim.scene import load_scene
from sim.world import World

ROBOT = Robot.load()


@pytest.mark.sim
def test_everything_stands_where_the_world_has_it() -> None:
    scene = load_scene("targets-hidden", 4)
    wear = body_of(ROBOT, "worn", 4)
    with World(ROBOT, scene, seed=4, wear=wear) as world:
        world.set_latch("released")
        world.command_servos(
            "arm", ServoCommand(joints=("shoulder", "elbow"), goal_rad=(0.4, 0.5), speed_radps=(1.0, 1.0))
        )
        for _ in range(60):
            world.step()
        stage = OutsideStage(wear.robot, scene)
        at = dict(zip([visual.name for visual in world.visuals], world.visual_poses(), strict=True))
        drawn = dict(zip([visual.name for visual in stage.visuals], stage.poses(world.truth()), strict=True))
    assert at.keys() == drawn.keys()
    for name, pose in drawn.items():
        assert pose[:3, 3] == pytest.approx(at[name][:3, 3], abs=1e-5), name
        if not name.startswith("wheel"):
            assert pose == pytest.approx(at[name], abs=1e-4), name


def test_a_stage_is_made_again_from_a_recorded_configuration() -> None:
    own = b'name = "own"\n[[object]]\nlabel = "mug"\nshape = "sphere"\nradius_m = 0.05\nposition_m = [1.0, 0.0]\n'
    stage = stage_of(ROBOT, {"scene": "/gone/own.toml", "seed": 2, "body": "worn"}, {"scene": own})
    assert [item.label for item in stage.scene.objects] == ["mug"]
    assert stage.robot.to_data() == body_of(ROBOT, "worn", 2).robot.to_data()
    assert [body.name for body in stage.bodies if not body.on_robot] == ["mug"]
    assert len(stage.visuals) == sum(len(body.visuals) for body in stage.bodies)
    with pytest.raises(ConfigError, match="no_such"):
        stage_of(ROBOT, {"no_such": 1}, {})


@pytest.mark.sim
def test_a_truth_of_another_scene_is_refused() -> None:
    with World(ROBOT, load_scene("wheels", 0)) as world:
        truth = world.truth()
    with pytest.raises(ConfigError, match="blue_ball"):
        OutsideStage(ROBOT, load_scene("follow", 0)).poses(truth)
    assert np.isfinite(OutsideStage(ROBOT, load_scene("wheels", 0)).poses(truth)).all()
