"""The features of a robot for learning: what a row of a dataset has, and what a policy sees and proposes.

The export of captures and the service that runs a policy both make their rows here, so that a policy sees what it was
trained with: the same values in the same order, in the same units, by the same rule of time.

A row has a time. Its picture is of that time; its state is held: of each source the newest whose stamp is not later.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike

from cocoro.arrays import Float32Array, ImageArray
from cocoro.messages import Frame
from cocoro.robot import Robot
from cocoro.topics import ARM_STATE, FRAME, HAND_STATE
from cocoro.units import Positive

STATE, ACTION = "observation.state", "action"
PICTURES = f"observation.images.{FRAME.service}"
BASE_NAMES = ("x.vel", "theta.vel")
"""Speed ahead, m/s, and turn rate, rad/s, counter-clockwise; the names of LeRobot's own mobile robot."""
ASIDE_NAME = "y.vel"
"""Speed to the left, m/s, between the two, of a base that can move aside."""
JOINT_STATES = (ARM_STATE, HAND_STATE)
MOST_ROWS = 256
"""Of a chunk of actions."""


def names_of(robot: Robot) -> list[str]:
    """Names of the values of state and action."""
    ahead, turn = BASE_NAMES
    aside = [ASIDE_NAME] if robot.drive.goes_aside else []
    return [*(f"{joint}.pos" for joint in robot.joints), ahead, *aside, turn]


def rows_of(angles_rad: Sequence[ArrayLike], base: ArrayLike) -> Float32Array:
    """Rows of states or actions, shape (rows, values). `angles_rad`: of each joint in the description's order, a number
    or shape (rows,); `base`: speed ahead, m/s, that to the left of a base that can move aside, and turn rate, rad/s,
    shape (rows, 2 or 3)."""
    return np.column_stack([*angles_rad, np.atleast_2d(base)]).astype(np.float32)


def picture_of(frame: Frame) -> ImageArray:
    """A row's picture: the colours, RGB, shape (height, width, 3)."""
    return np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)


class PolicyFeatures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a policy declares of itself: the features that it was trained with."""

    state: tuple[str, ...]
    """Names of the values of `observation.state`, in order."""
    action: tuple[str, ...]
    """Names of the values of `action`, in order."""
    rate_hz: Positive
    """Rows follow each other at this rate: those of the dataset, and those of a chunk."""
    chunk: Annotated[int, Meta(ge=1, le=MOST_ROWS)] = 1
    """Rows of actions that it proposes at once. The first one is for the time of the observation."""
    every: Annotated[int, Meta(ge=1, le=MOST_ROWS)] | None = None
    """Rows between two observations; None is half a chunk, so that the other half is there to think in."""
    width: Annotated[int, Meta(ge=1)] | None = None
    height: Annotated[int, Meta(ge=1)] | None = None
    """Of its pictures, pixels; None: it looks at none."""
    robot: str = ""
    """Name of the robot that it was trained with, for people; '' does not say."""

    def __post_init__(self) -> None:
        if (self.width is None) != (self.height is None):
            raise ValueError("pictures need both width and height; a policy without pictures has neither")

    @property
    def rows_between(self) -> int:
        """Rows from one observation to the next."""
        return self.every or max(1, self.chunk // 2)

    def differs(self, robot: Robot) -> str:
        """What of it is not as the robot has it, one sentence; '' when all is."""
        names = names_of(robot)
        for feature, have in ((STATE, self.state), (ACTION, self.action)):
            if (reason := _differs(have, names)) != "":
                return f"its {feature} does not fit the robot {robot.name}: {reason}"
        return ""

    def misfit(self, width: int, height: int) -> str:
        """Why it cannot look at pictures of a size, one sentence; '' when it can, or looks at none."""
        if self.width is None or (self.width, self.height) == (width, height):
            return ""
        return f"it looks at pictures of {self.width} x {self.height} pixels, the robot's have {width} x {height}"


def _differs(have: Sequence[str], want: Sequence[str]) -> str:
    if unknown := [name for name in have if name not in want]:
        return f"the robot has no {', '.join(unknown)}"
    if missing := [name for name in want if name not in have]:
        return f"{', '.join(missing)} is missing" if len(missing) == 1 else f"{', '.join(missing)} are missing"
    for number, (mine, theirs) in enumerate(zip_longest(have, want)):
        if mine != theirs:
            return f"value {number} is {mine}, the robot's is {theirs}"
    return ""
