"""The paper's scene and random scenes at the distances of a robot's arm: `paper-scaled` and `random-scaled`.

Sizes are those of the known objects, so that a robot with a small hand is rehearsed with its own objects file.
"""

from __future__ import annotations

import msgspec

from cocoro.objects import Catalogue
from cocoro.robot import Robot
from sim.scene import Scene

SCALED = "-scaled"
_REACH_M = 0.49
"""Distance from the arm's axis at which the robot grasps that the scenes were made for."""


def scale_of(robot: Robot | None) -> float:
    """The distances of a robot's scenes as a share of those that the project's scenes have."""
    return 1.0 if robot is None or robot.reach is None else robot.reach.grasp_radius_m / _REACH_M


def nearer(scene: Scene, scale: float, catalogue: Catalogue) -> Scene:
    """A scene whose objects stand at this share of their distances and have the sizes of the known objects."""
    return msgspec.structs.replace(
        scene,
        name=scene.name + SCALED,
        objects=tuple(
            msgspec.structs.replace(
                item,
                position_m=(scale * item.position_m[0], scale * item.position_m[1]),
                radius_m=known.radius_m,
                height_m=known.height_m,
                size_m=known.box_m,
            )
            for item in scene.objects
            if (known := catalogue.get(item.label)) is not None
        ),
    )
