"""The simulated world as an onlooker sees it: what there is to draw, and where it is by the published truth alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np

from cocoro.arrays import FloatArray
from cocoro.errors import ConfigError
from cocoro.kinematics import Tree
from cocoro.messages import Truth
from cocoro.robot import Robot
from sim.body import CHASSIS
from sim.model import build_model
from sim.random_scene import find_scene
from sim.realism import body_of
from sim.render.interface import Visual
from sim.rigid import rotation
from sim.scene import Scene
from sim.service import SimConfig


class StagedBody:
    """A rigid body of the stage: a link of the robot, or an object of the scene."""

    def __init__(self, name: str, on_robot: bool) -> None:
        self.name = name
        self.on_robot = on_robot
        self.visuals: list[Visual] = []
        self.offsets: list[FloatArray] = []
        """Poses of the visuals in the body's frame, (4, 4) each."""


class OutsideStage:
    """The robot's true body and its scene. `bodies` and `visuals` have one order, the robot's links first."""

    def __init__(self, robot: Robot, scene: Scene) -> None:
        """`robot` is the description of the true body."""
        self.robot = robot
        self.scene = scene
        model = build_model(robot)
        self._fixed: dict[str, FloatArray] = {CHASSIS: np.eye(4)}
        for extra in model.body.extras:
            place = np.eye(4)
            place[:3, 3] = extra.position_m
            self._fixed[extra.name] = place
        links: dict[str, StagedBody] = {}
        for carrier, offset, visual in model.visuals():
            body = links.setdefault(carrier, StagedBody(carrier, on_robot=True))
            body.visuals.append(visual)
            body.offsets.append(offset)
        self._tree = Tree(robot.links, [name for name in links if name not in self._fixed])
        self.bodies = list(links.values())
        solids = [(item.label, item) for item in scene.objects]
        named = [*solids, *((f"obstacle_{number}", item) for number, item in enumerate(scene.obstacles, 1))]
        for label, item in named:
            body = StagedBody(label, on_robot=False)
            body.visuals.append(Visual(label, item.shape, item.dimensions_m, item.colour))
            body.offsets.append(np.eye(4))
            self.bodies.append(body)
        self.visuals: list[Visual] = [visual for body in self.bodies for visual in body.visuals]

    def body_poses(self, truth: Truth) -> list[FloatArray]:
        """World pose (4, 4) of each of `bodies`. The wheels do not turn: the truth does not have their angles. Raises
        ConfigError for a truth of another scene or robot."""
        root = _pose(truth.body_m, truth.body_orientation)
        objects = {item.label: item for item in truth.objects}
        try:
            links = self._tree.poses(truth.joints_rad)
            return [
                root @ (self._fixed[body.name] if body.name in self._fixed else links[body.name])
                if body.on_robot
                else _pose(objects[body.name].position_m, objects[body.name].orientation)
                for body in self.bodies
            ]
        except KeyError as error:
            raise ConfigError(
                f"the truth has no {error}: it is of another robot or scene than the one stated"
            ) from error

    def poses(self, truth: Truth) -> FloatArray:
        """World poses of `visuals` in their order, (n, 4, 4)."""
        poses = zip(self.bodies, self.body_poses(truth), strict=True)
        return np.array([pose @ offset for body, pose in poses for offset in body.offsets])


def stage_of(robot: Robot, settings: Mapping[str, Any], files: Mapping[str, bytes]) -> OutsideStage:
    """The stage of a simulator's configuration.

    `robot` is the nominal description; `settings` are the fields of a SimConfig, and `files` the contents of the files
    that they name, by field. Raises ConfigError when they are not a simulator's, or fit today's simulator no more.
    """
    with TemporaryDirectory(prefix="cocoro-") as folder:
        paths = {}
        for field, content in files.items():
            path = Path(folder) / f"{field}.toml"
            path.write_bytes(content)
            paths[field] = str(path)
        try:
            config = msgspec.convert({**settings, **paths}, SimConfig)
        except msgspec.ValidationError as error:
            raise ConfigError(f"the simulator's configuration does not fit today's: {error}") from error
        scene = find_scene(config.scene, config.seed, config.target, config.objects, robot)
    return OutsideStage(body_of(robot, config.body, config.seed, config.bend_at_s).robot, scene)


def _pose(place_m: tuple[float, float, float], orientation: tuple[float, float, float, float]) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3] = rotation(orientation)
    pose[:3, 3] = place_m
    return pose
