"""The planner's settings for a robot whose camera sees no depth."""

from __future__ import annotations

from msgspec.structs import replace

from cocoro.robot import Robot
from services.planning.config import PlanningConfig


def of_sight(config: PlanningConfig, robot: Robot) -> PlanningConfig:
    """The settings, with the base no faster anywhere than over unseen floor where the camera sees no depth: floor by
    its colour alone may be something of the floor's colour."""
    if robot.sees_depth:
        return config
    most_mps = config.navigation.blind_mps
    return replace(
        config,
        navigation=replace(
            config.navigation,
            max_speed_mps=min(config.navigation.max_speed_mps, most_mps),
            detour_speed_mps=min(config.navigation.detour_speed_mps, most_mps),
        ),
        follow=replace(
            config.follow,
            max_speed_mps=min(config.follow.max_speed_mps, most_mps),
            round_speed_mps=min(config.follow.round_speed_mps, most_mps),
        ),
        search=replace(config.search, max_speed_mps=min(config.search.max_speed_mps, most_mps)),
    )
