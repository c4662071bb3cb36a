"""The planner's settings for one robot: what follows from its body, or stands in its description, where a profile has
not set it otherwise. For the Calliope all of it comes out as the settings' own values, which were chosen on one."""

from __future__ import annotations

from math import ceil, sin
from typing import TypeVar

import msgspec
from msgspec.structs import replace

from cocoro.description_limbs import Reach
from cocoro.drive import Twist
from cocoro.robot import Robot
from services.planning.config import ArmConfig, PlanningConfig
from services.planning.hand import finger_m, gap_m, side_room_m

_TOP_SHARE = 0.96
"""Share of the wheels' top speed that is used, so that they can still correct the course."""
_SIGMAS = 1.75
"""The room that the open hand leaves on either side of a thing, as a multiple of the greatest doubt of its place."""
_HAND_MARGIN_M = 0.01
"""The hand's half width goes up to the next multiple of this."""

_PAIR = 2
"""A single jaw goes on as far after the contact as two do together: there is no pair that has to be in balance."""

_T = TypeVar("_T", bound=msgspec.Struct)


def of_body(config: PlanningConfig, robot: Robot) -> PlanningConfig:
    """The settings for this robot. Speeds only become less: a driver that counts on more than the wheels can do brakes
    too early, and a hand that goes as fast on shorter links bends further off its way between two steps."""
    most_mps = round(_TOP_SHARE * robot.base.max_wheel_speed_mps / robot.drive.fastest(Twist(1.0, 0.0)), 3)
    hand = config.hand
    if robot.claw.open_rad is not None:
        hand = _where_own(hand, open_rad=robot.claw.open_rad)
    hand = _where_own(hand, clamp_rad=_PAIR / len(robot.jaws) * hand.clamp_rad)
    arm = _where_own(config.arm, **_reach(robot.reach)) if robot.reach is not None else config.arm
    low_m = _lowest_m(robot, arm)
    side_m = (gap_m(robot, hand.open_rad) - robot.claw.pad_gap_m) / 2
    share = min(arm.grasp_radius_m / ArmConfig().grasp_radius_m, 1.0)
    speeds = ("hand_speed_mps", "insert_speed_mps", "lift_speed_mps")
    arm = _where_own(
        arm,
        **{name: round(share * getattr(arm, name), 3) for name in speeds},
        grasp_sigma_m=round(side_m / _SIGMAS, 3),
        grasp_height_range_m=(low_m, arm.grasp_height_range_m[1]),
    )
    by_hand = _where_own(
        config.by_hand,
        radius_m=(round(arm.retreat_radius_m - 0.07, 3), round(arm.touch_radius_range_m[1] + 0.04, 3)),
    )
    half_m = finger_m(robot, hand.open_rad) - side_room_m(robot, hand, robot.claw.pad_gap_m)
    half_m = _HAND_MARGIN_M * ceil(half_m / _HAND_MARGIN_M)
    return replace(
        config,
        arm=arm,
        hand=hand,
        by_hand=by_hand,
        navigation=_slower(
            _where_own(config.navigation, hand_half_width_m=round(half_m, 3)), most_mps, "max_speed_mps"
        ),
        follow=_slower(config.follow, most_mps, "max_speed_mps", "round_speed_mps"),
    )


def _reach(reach: Reach) -> dict[str, object]:
    return {name: getattr(reach, name) for name in reach.__struct_fields__}


def _lowest_m(robot: Robot, arm: ArmConfig) -> float:
    """The least height at which the level hand closes in: its fingers' ends, which point down a little, clear the floor
    twice over, for the hand sags."""
    ends_m = robot.claw.pad_length_m / 2 * sin(-arm.pitch_rad)
    return round(robot.hull.finger_radius_m + ends_m + 2 * arm.clearance_m, 3)


def _where_own(config: _T, **told: object) -> _T:
    """The settings with these values, where they are the planner's own."""
    own = type(config)()
    left = {name: value for name, value in told.items() if getattr(config, name) == getattr(own, name)}
    return replace(config, **left)


def _slower(config: _T, most_mps: float, *names: str) -> _T:
    return replace(config, **{name: min(getattr(config, name), most_mps) for name in names})
