"""How a real body differs from a perfect one: figures and their noise (the design's 'Real sensors').

The camera's own noise is the camera's; latency is the service's.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sqrt
from typing import Literal

import numpy as np

from cocoro.arrays import FloatArray
from sim.seeds import stream

Sensors = Literal["ideal", "real"]


@dataclass(frozen=True)
class BodyRealism:
    backlash_deg: float = 0.0
    servo_speed_scatter: float = 0.0
    """Standard deviation of a servo's speed about what it was told, as a share of it."""
    wheel_scale_error: float = 0.0
    """Each wheel rolls longer or shorter than its nominal radius says, evenly within +- this share, the whole run."""
    wheel_slip: float = 0.0
    """Standard deviation of what a wheel slips, as a share of its way."""
    scatter_time_s: float = 0.5
    slip_time_s: float = 0.2
    """For how long scatter and slip stay about the same."""
    exact_odometry: bool = True


REALISM: dict[Sensors, BodyRealism] = {
    "ideal": BodyRealism(),
    "real": BodyRealism(
        backlash_deg=0.5,
        servo_speed_scatter=0.02,
        wheel_scale_error=0.02,
        wheel_slip=0.01,
        exact_odometry=False,
    ),
}


def wheel_scales(seed: int, realism: BodyRealism) -> FloatArray:
    """How far the left and the right wheel of a run roll for a metre that they are told to; shape (2,)."""
    return np.asarray(1.0 + stream(seed, "wheel scale").uniform(-1.0, 1.0, 2) * realism.wheel_scale_error)


class Wander:
    """Numbers that wander about 0 with a given spread: a first-order autoregressive process, one a channel.

    White noise at the rate of the physics would average out to nothing; this lasts for about `time_s`.
    """

    def __init__(self, draws: np.random.Generator, channels: int, sigma: float, time_s: float, dt_s: float) -> None:
        self._draws = draws
        self._keep = exp(-dt_s / time_s)
        self._add = sigma * sqrt(1.0 - self._keep**2)
        self.values: FloatArray = sigma * draws.standard_normal(channels)

    def step(self) -> FloatArray:
        """The next values, shape (channels,), `dt_s` later."""
        self.values = self._keep * self.values + self._add * self._draws.standard_normal(self.values.size)
        return self.values
