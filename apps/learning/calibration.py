"""The rigid body as strong as its source allows: the nominal model with its geometry fitted to the sightings.

The nominal model is the geometry as it was drawn. An engineer who has one and a camera measures how the robot differs
from it: at least the joints' zeros, at most the place and the direction of every joint's axis. Both are fitted here by
least squares to the same sightings from which the network learns (kinematic calibration: Mooring, Roth and Driels 1991;
the equations are derived).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from apps.learning.sightings import Sightings
from cocoro.arrays import BoolArray, FloatArray
from cocoro.learning.handmap import HandMap, NominalModel
from cocoro.learning.network import PAPER_RANGE_RAD, HyperplaneRbf, LeastSquares

Freedom = Literal["zeros", "hand", "all"]
"""What is fitted: the joints' zeros; these, the marker's place on the hand and the camera's mounting; or everything."""

PLACE_M, TURN_RAD = 0.005, np.radians(2.0)
"""Standard deviations of errors of making, before anything is measured. They keep directions that the sightings do not
tell apart, such as the length of one link against that of the next, near the drawing."""
SIGHTING_M = 0.004
"""Standard deviation of a sighting."""
_ITERATIONS = 20
_STEP = 1e-6
_POSTURES, _BASES, _WIDTH_RAD = 4000, 4, 1.05


class CalibratedModel(NominalModel):
    """The nominal model with corrected geometry: a small displacement in front of each joint, and of the marker.

    `corrections` (6 n + 3,): for each joint from the body on the displacement (3,) in metres and the rotation vector
    (3,) in radians of its axis, in the frame that the axis is z of; then the marker's displacement (3,), metres.
    """

    def __init__(self, nominal: NominalModel, corrections: FloatArray) -> None:
        self.__dict__.update(nominal.__dict__)
        self._steps = [
            (fixed @ displacement(corrections[6 * number : 6 * number + 6]), which, offset_rad)
            for number, (fixed, which, offset_rad) in enumerate(nominal._steps)
        ]
        self._marker = nominal._marker + np.append(corrections[-3:], 0.0)


def displacement(correction: FloatArray) -> FloatArray:
    """The transform (4, 4) of a displacement (3,), metres, and a rotation vector (3,), radians, in one array (6,)."""
    angle = float(np.linalg.norm(correction[3:]))
    x, y, z = correction[3:] / angle if angle > 0 else np.zeros(3)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    transform = np.eye(4)
    transform[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    transform[:3, 3] = correction[:3]
    return transform


def fitted(freedom: Freedom, joints: int) -> BoolArray:
    """Which of the 6 n + 3 corrections are fitted, for n joints."""
    mask = np.zeros(6 * joints + 3, dtype=np.bool_)
    mask[5::6] = True  # the turn about a joint's own axis is its zero
    if freedom != "zeros":
        mask[:6] = True  # where the whole arm is seen
        mask[-3:] = True
    return mask if freedom != "all" else np.ones_like(mask)


def calibrate(nominal: NominalModel, sightings: Sightings, freedom: Freedom = "all") -> CalibratedModel:
    """Fit the geometry to sightings: Gauss-Newton with Huber weights, and with a prior of the errors of making."""
    mask = np.flatnonzero(fitted(freedom, len(nominal.joints)))
    prior = np.tile([PLACE_M] * 3 + [TURN_RAD] * 3, len(nominal.joints) + 1)[:-3]
    corrections, axes = np.zeros(len(prior)), np.eye(len(prior))

    def places_m(at: FloatArray) -> FloatArray:
        return CalibratedModel(nominal, at).predict(sightings.angles_rad)

    for _ in range(_ITERATIONS):
        computed = places_m(corrections)
        gaps = sightings.places_m - computed
        weights = 1.0 / np.maximum(np.linalg.norm(gaps, axis=1) / (2 * SIGHTING_M), 1.0) / SIGHTING_M**2
        slopes = np.stack([(places_m(corrections + _STEP * axes[one]) - computed) / _STEP for one in mask], axis=2)
        weighed = slopes * weights[:, None, None]
        normal = np.einsum("bki,bkj->ij", weighed, slopes) + np.diag(prior[mask] ** -2.0)
        move = np.linalg.solve(normal, np.einsum("bki,bk->i", weighed, gaps) - corrections[mask] / prior[mask] ** 2)
        corrections[mask] += move
        if float(np.abs(move).max()) < 1e-9:
            break
    return CalibratedModel(nominal, corrections)


def as_map(calibrated: NominalModel, nominal: NominalModel) -> HandMap:
    """The calibrated rigid body in the form that the planner takes: a network of its difference from the nominal model,
    set by least squares on many postures within the joints' limits. It adds about 0.1 mm."""
    limits_rad = nominal.limits_rad.clip(-PAPER_RANGE_RAD, PAPER_RANGE_RAD)
    low, high = limits_rad.T
    count = len(limits_rad)
    angles = np.random.default_rng(0).uniform(low, high, (_POSTURES, count))
    network = HyperplaneRbf.spread([_BASES] * count, [_WIDTH_RAD] * count, limits_rad)
    LeastSquares(network, doubt=1e4).add_all(angles, calibrated.predict(angles) - nominal.predict(angles))
    return HandMap(nominal, network)
