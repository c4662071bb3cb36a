"""What a policy in Python is: a learned or written rule that makes actions of observations.

    class Nod:
        def __init__(self, robot: Robot) -> None:
            names = tuple(names_of(robot))
            self.features = PolicyFeatures(state=names, action=names, rate_hz=10.0, chunk=10)

        def reset(self) -> None: ...

        def act(self, observation: Observation) -> FloatArray | None:
            return np.tile(observation[STATE], (10, 1))

A distribution adds one by an entry point of the group `cocoro.policies`; a profile or a rehearsal names one as
`module:callable`. Either is called with the robot and returns the policy (docs/policies.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cocoro.errors import CocoroError
from cocoro.features import PolicyFeatures

GROUP = "cocoro.policies"
"""The entry point group of policies."""

Observation = Mapping[str, NDArray[Any]]
"""By feature: `observation.state`, float32, shape (values,); and, if the policy looks at pictures,
`observation.images.kinect`, uint8, RGB, shape (height, width, 3)."""


class PolicyError(CocoroError):
    """A policy cannot be loaded, does not fit the robot, or proposes what nobody can follow."""


class Policy(Protocol):
    """A policy that is ready to run. It is called by one thread, never twice at a time."""

    features: PolicyFeatures

    def reset(self) -> None:
        """A new run begins."""

    def act(self, observation: Observation) -> NDArray[np.floating] | None:
        """The actions from the time of the observation on, shape (chunk, values) or, for one row, (values,); None when
        the policy has finished."""
