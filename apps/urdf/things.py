"""Known objects and scenes for a new robot: the project's, in sizes for its hand and at places that it reaches."""

from __future__ import annotations

from collections.abc import Iterator
from math import cos, radians, sin

from cocoro.objects import own_text
from cocoro.robot import Robot
from services.planning.config import ArmConfig, PlanningConfig
from services.planning.hand import widest_m
from services.planning.of_body import of_body

CAN_M, HIGH_M, BALL_M = 0.033, 0.120, 0.030
"""The project's cans, radius and height, and its ball."""
_SHARE = 0.3
"""Radius of a can by the width of what the open hand takes."""
_LEAST_M = 0.008
_CANS = (("red_can", 1.5, 0.0), ("green_can", 1.4, -45.0), ("blue_can", 1.0, 45.0))
"""The paper's scene: distances, m, and directions, degrees, about the robot's middle."""
_SCALES = (0.6, 1.2)
_TARGETS = (("red_can", 0.1, 0.17), ("green_can", -0.4, 0.17), ("blue_can", -0.4, 0.07), ("yellow_ball", 0.1, 0.07))
"""The paper's targets: direction, rad, about the axis of the arm's first joint, and height, m."""


def can_m(robot: Robot) -> tuple[float, float]:
    """Radius and height of the cans for its hand: the project's, or smaller ones."""
    wide_m = _opening_m(robot)
    if _SHARE * wide_m >= CAN_M:
        return CAN_M, HIGH_M
    radius_m = round(max(_SHARE * wide_m, _LEAST_M), 3)
    return radius_m, round(min(HIGH_M, max(5.0 * radius_m, 0.10)), 3)


def _opening_m(robot: Robot) -> float:
    """Width of what the open hand goes around, m. The gap of a pair of jaws is assumed, and fingers are thick: it does
    not count."""
    wide_m = widest_m(robot, of_body(PlanningConfig(), robot).hand)
    return wide_m if robot.claw.fixed_pad_m is not None else wide_m - robot.claw.pad_gap_m


def objects_text(name: str, robot: Robot) -> str | None:
    """Its known objects as TOML; None where they are the project's."""
    radius_m, height_m = can_m(robot)
    if radius_m == CAN_M:
        return None
    rows = own_text()[own_text().index("[[object]]") :]
    rows = rows.replace(f"radius_m = {CAN_M}\nheight_m = {HIGH_M:.3f}", f"radius_m = {radius_m}\nheight_m = {height_m}")
    rows = rows.replace(f"radius_m = {BALL_M:.3f}", f"radius_m = {min(radius_m, BALL_M)}")
    wide_mm = 1000.0 * _opening_m(robot)
    return f"# The known objects of {name}: the project's, in sizes for a hand that takes {wide_mm:.0f} mm.\n\n{rows}"


def scene_texts(name: str, robot: Robot) -> Iterator[tuple[str, str]]:
    """Names of its own scenes, and what is in their files."""
    radius_m, height_m = can_m(robot)
    can = f'shape = "cylinder"\nradius_m = {radius_m}\nheight_m = {height_m}\n'
    reach = of_body(PlanningConfig(), robot).arm
    scale = min(max(reach.grasp_radius_m / ArmConfig().grasp_radius_m, _SCALES[0]), _SCALES[1])
    yield "paper", _scene(
        "paper", f"The scene `paper` of {name}: the paper's directions, {scale:.2f} times its distances.",
        [f'label = "{label}"\n{can}position_m = {_place(scale * far, radians(deg))}\n' for label, far, deg in _CANS],
    ) + "\n[scatter]\nposition_m = 0.02\n"  # fmt: skip
    if robot.reach is None:
        return
    low_m, high_m = robot.reach.touch_radius_range_m
    x_m, y_m, _ = robot.chain(robot.link_of(robot.arm.azimuth)).position({robot.arm.azimuth: 0.0}).tolist()
    ball = f'shape = "sphere"\nradius_m = {min(radius_m, BALL_M)}\n'
    yield "targets", _scene(
        "targets", f"The scene `targets` of {name}: four targets in the air where its arm reaches.",
        [
            f'label = "{label}"\n{can if label.endswith("can") else ball}'
            f"position_m = {_place((low_m + high_m) / 2, turn, x_m, y_m, up_m)}\nfloating = true\n"
            for label, turn, up_m in _TARGETS
        ],
    )  # fmt: skip


def _scene(name: str, about: str, objects: list[str]) -> str:
    return f'# {about}\nname = "{name}"\n' + "".join(f"\n[[object]]\n{row}" for row in objects)


def _place(far_m: float, turn_rad: float, x_m: float = 0.0, y_m: float = 0.0, up_m: float | None = None) -> list[float]:
    place = [x_m + far_m * cos(turn_rad), y_m + far_m * sin(turn_rad)]
    return [round(value, 3) for value in (place if up_m is None else [*place, up_m])]
