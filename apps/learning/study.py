"""Comparison of methods for learning the hand-eye map: all are fitted to the same sightings and scored on others.

Whole draws of the babbling are held out, not single sightings: frames of one move are centimetres apart, so a map that
has learned one of them knows the next. The method is chosen by cross-validation on the draws that are not held out; the
held-out draws only measure the error.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from apps.learning.rules import folds, inliers, learn_in_order, plausible
from cocoro.arrays import BoolArray, FloatArray, IntArray
from cocoro.learning.handmap import Coordinates, HandMap, NominalModel
from cocoro.learning.network import (
    PAPER_BASES,
    PAPER_RANGE_RAD,
    PAPER_RATE,
    PAPER_WIDTH_RAD,
    HyperplaneRbf,
    LeastSquares,
)

PRIMING_SHARE = 0.1
"""Weight (or rate) of a priming point against a sighting."""
HELD_OUT = 5
"""Every fifth draw is held out."""
FOLDS = 4
CHANCE = 0.05
"""Relative difference of errors below which no method counts as better."""


@dataclass(frozen=True)
class Sightings:
    """Sightings as arrays: angles (b, n) rad, positions (b, 3) m in the body frame, numbers of the draws (b,)."""

    angles_rad: FloatArray
    places_m: FloatArray
    draws: IntArray

    def __len__(self) -> int:
        return len(self.draws)

    def pick(self, mask: BoolArray | slice) -> Sightings:
        """The sightings of a mask (b,) or slice."""
        return Sightings(self.angles_rad[mask], self.places_m[mask], self.draws[mask])


@dataclass(frozen=True)
class Method:
    """One method of learning."""

    name: str
    rule: Literal["in order", "least squares"] = "least squares"
    over_nominal: bool = True
    """The network learns what the nominal model leaves unexplained; else the whole map, primed by the nominal model."""
    coordinates: Coordinates = "cartesian"
    bases: int = PAPER_BASES
    """Bases per joint."""
    width_rad: float = PAPER_WIDTH_RAD
    rate: float = PAPER_RATE
    """For "in order": a in the paper's rule."""
    doubt: float = 100.0
    """For "least squares": prior variance of the weights in units of a sighting's variance."""


BEST = Method("81 bases over the nominal model, least squares")
METHODS: tuple[Method, ...] = (
    Method("the paper's rule, 81 bases", "in order", over_nominal=False),
    Method("the paper's rule, spherical", "in order", over_nominal=False, coordinates="spherical"),
    Method("the paper's rule over the nominal model", "in order"),
    Method("81 bases, least squares", over_nominal=False),
    Method("256 bases, least squares", over_nominal=False, bases=4, width_rad=1.05),
    BEST,
    Method("81 bases over the nominal model, spherical", coordinates="spherical"),
    Method("16 bases over the nominal model", bases=2, width_rad=2.5),
    Method("256 bases over the nominal model", bases=4, width_rad=1.05),
)


class Score(NamedTuple):
    """Errors of one method: distances between seen and predicted positions of the hand, metres."""

    name: str
    cross_validated_m: float
    """Root mean square of the cross-validation; NaN with too few draws."""
    held_out_m: float
    """Root mean square over the held-out draws."""
    held_out_95_m: float
    """95th percentile over the held-out draws."""
    fit_s: float


def clean(sightings: Sightings, nominal: NominalModel) -> Sightings:
    """The sightings without outliers: those without a near neighbour, and those that disagree with all others."""
    near = sightings.pick(inliers(sightings.places_m))
    if len(near) < 20:
        return near
    gap = near.places_m - nominal.predict(near.angles_rad)
    return near.pick(plausible(gap - np.median(gap, axis=0)))


def split(sightings: Sightings, every: int = HELD_OUT) -> tuple[Sightings, Sightings]:
    """(to learn from, held out): every `every`th draw with sightings is held out as a whole."""
    names = np.unique(sightings.draws)
    held = np.isin(sightings.draws, names[every - 1 :: every])
    return sightings.pick(~held), sightings.pick(held)


def fit(method: Method, nominal: NominalModel, sightings: Sightings) -> HandMap:
    """Fit a map to the sightings."""
    learned, learner = begin(method, nominal)
    targets = learned.targets(sightings.angles_rad, sightings.places_m)
    if learner is None:
        learn_in_order(learned.network, sightings.angles_rad, targets, method.rate)
    else:
        learner.add_all(sightings.angles_rad, targets)
    return learned


def begin(method: Method, nominal: NominalModel) -> tuple[HandMap, LeastSquares | None]:
    """A map without sightings, primed where it does not add to the nominal model, and its learner.

    The learner is None for the paper's rule, whose only state is the weights.
    """
    learned, learner = _primed(method, nominal)
    network = learned.network.copy()
    return HandMap(
        nominal, network, over_nominal=method.over_nominal, coordinates=method.coordinates
    ), None if learner is None else learner.copy(network)


@lru_cache(maxsize=16)
def _primed(method: Method, nominal: NominalModel) -> tuple[HandMap, LeastSquares | None]:
    count = len(nominal.joints)
    ranges = np.tile([-PAPER_RANGE_RAD, PAPER_RANGE_RAD], (count, 1))
    network = HyperplaneRbf.spread([method.bases] * count, [method.width_rad] * count, ranges)
    learned = HandMap(nominal, network, over_nominal=method.over_nominal, coordinates=method.coordinates)
    learner = LeastSquares(network, method.doubt) if method.rule == "least squares" else None
    if not method.over_nominal:
        angles, places = nominal.priming()
        targets = learned.targets(angles, places)
        if learner is None:
            learn_in_order(network, angles, targets, PRIMING_SHARE * method.rate)
        else:
            learner.add_all(angles, targets, PRIMING_SHARE)
    return learned, learner


def errors_m(learned: HandMap | NominalModel, sightings: Sightings) -> FloatArray:
    """Distances (b,), metres, between seen and predicted positions."""
    return np.asarray(np.linalg.norm(learned.predict(sightings.angles_rad) - sightings.places_m, axis=1))


def rms(errors: FloatArray) -> float:
    """Root mean square of errors (b,), in their unit; NaN without errors."""
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")


def score(method: Method, nominal: NominalModel, learn: Sightings, held: Sightings, *, validate: bool = True) -> Score:
    started = time.process_time()
    learned = fit(method, nominal, learn)
    took_s = time.process_time() - started
    errors = errors_m(learned, held)
    checked = cross_validate(method, nominal, learn) if validate else float("nan")
    return Score(method.name, checked, rms(errors), float(np.quantile(errors, 0.95)), took_s)


def cross_validate(method: Method, nominal: NominalModel, learn: Sightings) -> float:
    """Root mean square error, metres, over folds of whole draws; NaN with fewer draws than folds."""
    if len(np.unique(learn.draws)) < FOLDS:
        return float("nan")
    found = [errors_m(fit(method, nominal, learn.pick(a)), learn.pick(b)) for a, b in folds(learn.draws, FOLDS)]
    return rms(np.concatenate(found))


def baselines(nominal: NominalModel, learn: Sightings, held: Sightings) -> list[Score]:
    """Scores of the nominal model, and of it with the constant offset that fits the sightings best."""
    offset = (learn.places_m - nominal.predict(learn.angles_rad)).mean(axis=0)
    moved = replace(held, places_m=held.places_m - offset)
    return [
        Score(name, float("nan"), rms(errors), float(np.quantile(errors, 0.95)), 0.0)
        for name, errors in (
            ("the nominal model", errors_m(nominal, held)),
            ("the nominal model with its best constant offset", errors_m(nominal, moved)),
        )
    ]


def grid(rule: Literal["in order", "least squares"]) -> Sequence[Method]:
    """The methods of a grid search."""
    found = []
    for bases in (2, 3, 4):
        for width in (1.0, 1.57, 2.2):
            if rule == "in order":
                for rate in (0.025, 0.1, 0.3):
                    name = f"{bases**4} bases, sigma {width:g}, rate {rate:g}"
                    found.append(Method(name, rule, over_nominal=False, bases=bases, width_rad=width, rate=rate))
            else:
                for doubt in (10.0, 100.0, 1000.0):
                    name = f"{bases**4} bases over the nominal model, sigma {width:g}, doubt {doubt:g}"
                    found.append(Method(name, bases=bases, width_rad=width, doubt=doubt))
    return found


def best(scores: Sequence[Score], methods: Sequence[Method]) -> Method:
    """The method with the smallest cross-validated error. `BEST` is kept if no other is better by more than `CHANCE`,
    and if none could be validated."""
    checked = {method: s.cross_validated_m for s, method in zip(scores, methods, strict=True)}
    checked = {method: error for method, error in checked.items() if not np.isnan(error)}
    if not checked:
        return BEST if BEST in methods else methods[0]
    least = min(checked, key=lambda method: checked[method])
    return BEST if BEST in checked and checked[BEST] * (1 - CHANCE) <= checked[least] else least


def curve(
    method: Method, nominal: NominalModel, learn: Sightings, held: Sightings, sizes: Sequence[int]
) -> list[float]:
    """Held-out errors (RMS, m) after the first `sizes` sightings."""
    return [rms(errors_m(fit(method, nominal, learn.pick(slice(size))), held)) for size in sizes if size <= len(learn)]
