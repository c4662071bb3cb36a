"""Which way of learning the hand-eye map is best: all of them fitted to the same sightings and scored on others.

Whole draws of the babbling are held out, not single sightings: frames of one move lie centimetres apart, and a map that
has learned one of them knows the next. The method is chosen by cross-validation among what it may learn from; the
held-out draws only ever tell how good each is.
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
"""Priming points count a tenth of a sighting, in rate or in weight."""
HELD_OUT = 5
"""Every fifth draw is held out."""
FOLDS = 4
CHANCE = 0.05
"""Errors that differ by less, as a share, do not say which method is better."""


@dataclass(frozen=True)
class Sightings:
    """What was seen, as arrays: angles (b, n) rad, places (b, 3) m, draws (b,)."""

    angles_rad: FloatArray
    places_m: FloatArray
    draws: IntArray

    def __len__(self) -> int:
        return len(self.draws)

    def pick(self, mask: BoolArray | slice) -> Sightings:
        return Sightings(self.angles_rad[mask], self.places_m[mask], self.draws[mask])


@dataclass(frozen=True)
class Method:
    """One way of learning."""

    name: str
    rule: Literal["in order", "least squares"] = "least squares"
    over_nominal: bool = True
    """The network learns what the drawing leaves unexplained; else the whole map, primed by the drawing."""
    coordinates: Coordinates = "cartesian"
    bases: int = PAPER_BASES
    """A joint."""
    width_rad: float = PAPER_WIDTH_RAD
    rate: float = PAPER_RATE
    """In order: a in the paper's rule."""
    doubt: float = 100.0
    """Least squares: variance of the weights before anything was seen, in units of a sighting's."""


BEST = Method("81 bases over the drawing, least squares")
METHODS: tuple[Method, ...] = (
    Method("the paper's rule, 81 bases", "in order", over_nominal=False),
    Method("the paper's rule, spherical", "in order", over_nominal=False, coordinates="spherical"),
    Method("the paper's rule over the drawing", "in order"),
    Method("81 bases, least squares", over_nominal=False),
    Method("256 bases, least squares", over_nominal=False, bases=4, width_rad=1.05),
    BEST,
    Method("81 bases over the drawing, spherical", coordinates="spherical"),
    Method("16 bases over the drawing", bases=2, width_rad=2.5),
    Method("256 bases over the drawing", bases=4, width_rad=1.05),
)


class Score(NamedTuple):
    """Of one method. Errors are distances between where the hand was seen and where the map has it, metres."""

    name: str
    cross_validated_m: float
    """Root mean square, over what it may learn from. NaN where there were too few draws for it."""
    held_out_m: float
    """Root mean square, over the held-out draws."""
    held_out_95_m: float
    """95 of 100 are smaller."""
    fit_s: float


def clean(sightings: Sightings, drawing: NominalModel) -> Sightings:
    """Without the outliers: sightings that no other is near to, and those that disagree with all others."""
    near = sightings.pick(inliers(sightings.places_m))
    if len(near) < 20:
        return near
    gap = near.places_m - drawing.predict(near.angles_rad)
    return near.pick(plausible(gap - np.median(gap, axis=0)))


def split(sightings: Sightings, every: int = HELD_OUT) -> tuple[Sightings, Sightings]:
    """(to learn from, held out): each `every`th draw that was seen at all is held out, whole."""
    names = np.unique(sightings.draws)
    held = np.isin(sightings.draws, names[every - 1 :: every])
    return sightings.pick(~held), sightings.pick(held)


def fit(method: Method, drawing: NominalModel, sightings: Sightings) -> HandMap:
    """Learn a map."""
    learned, learner = begin(method, drawing)
    targets = learned.targets(sightings.angles_rad, sightings.places_m)
    if learner is None:
        learn_in_order(learned.network, sightings.angles_rad, targets, method.rate)
    else:
        learner.add_all(sightings.angles_rad, targets)
    return learned


def begin(method: Method, drawing: NominalModel) -> tuple[HandMap, LeastSquares | None]:
    """A map before anything was seen, primed where it does not stand on the drawing; and its learner (None: the
    paper's rule has no state but the weights)."""
    learned, learner = _primed(method, drawing)
    network = learned.network.copy()
    return HandMap(
        drawing, network, over_nominal=method.over_nominal, coordinates=method.coordinates
    ), None if learner is None else learner.copy(network)


@lru_cache(maxsize=16)
def _primed(method: Method, drawing: NominalModel) -> tuple[HandMap, LeastSquares | None]:
    count = len(drawing.joints)
    ranges = np.tile([-PAPER_RANGE_RAD, PAPER_RANGE_RAD], (count, 1))
    network = HyperplaneRbf.spread([method.bases] * count, [method.width_rad] * count, ranges)
    learned = HandMap(drawing, network, over_nominal=method.over_nominal, coordinates=method.coordinates)
    learner = LeastSquares(network, method.doubt) if method.rule == "least squares" else None
    if not method.over_nominal:
        angles, places = drawing.priming()
        targets = learned.targets(angles, places)
        if learner is None:
            learn_in_order(network, angles, targets, PRIMING_SHARE * method.rate)
        else:
            learner.add_all(angles, targets, PRIMING_SHARE)
    return learned, learner


def errors_m(learned: HandMap | NominalModel, sightings: Sightings) -> FloatArray:
    """Distances (b,) between where the hand was seen and where a map has it."""
    return np.asarray(np.linalg.norm(learned.predict(sightings.angles_rad) - sightings.places_m, axis=1))


def rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")


def score(method: Method, drawing: NominalModel, learn: Sightings, held: Sightings, *, validate: bool = True) -> Score:
    started = time.process_time()
    learned = fit(method, drawing, learn)
    took_s = time.process_time() - started
    errors = errors_m(learned, held)
    checked = cross_validate(method, drawing, learn) if validate else float("nan")
    return Score(method.name, checked, rms(errors), float(np.quantile(errors, 0.95)), took_s)


def cross_validate(method: Method, drawing: NominalModel, learn: Sightings) -> float:
    """Root mean square error over folds of whole draws; NaN with fewer draws than folds."""
    if len(np.unique(learn.draws)) < FOLDS:
        return float("nan")
    found = [errors_m(fit(method, drawing, learn.pick(a)), learn.pick(b)) for a, b in folds(learn.draws, FOLDS)]
    return rms(np.concatenate(found))


def baselines(drawing: NominalModel, learn: Sightings, held: Sightings) -> list[Score]:
    """The drawing as it stands, and with the constant hand offset that goes best with what may be learned from."""
    offset = (learn.places_m - drawing.predict(learn.angles_rad)).mean(axis=0)
    moved = replace(held, places_m=held.places_m - offset)
    return [
        Score(name, float("nan"), rms(errors), float(np.quantile(errors, 0.95)), 0.0)
        for name, errors in (
            ("the drawing", errors_m(drawing, held)),
            ("the drawing with its best constant offset", errors_m(drawing, moved)),
        )
    ]


def grid(rule: Literal["in order", "least squares"]) -> Sequence[Method]:
    """The methods that a grid search tries."""
    found = []
    for bases in (2, 3, 4):
        for width in (1.0, 1.57, 2.2):
            if rule == "in order":
                for rate in (0.025, 0.1, 0.3):
                    name = f"{bases**4} bases, sigma {width:g}, rate {rate:g}"
                    found.append(Method(name, rule, over_nominal=False, bases=bases, width_rad=width, rate=rate))
            else:
                for doubt in (10.0, 100.0, 1000.0):
                    name = f"{bases**4} bases over the drawing, sigma {width:g}, doubt {doubt:g}"
                    found.append(Method(name, bases=bases, width_rad=width, doubt=doubt))
    return found


def best(scores: Sequence[Score], methods: Sequence[Method]) -> Method:
    """The method of the smallest cross-validated error. The project's own stays where it is among them and no other is
    better by more than chance, or where none could be validated."""
    checked = {method: s.cross_validated_m for s, method in zip(scores, methods, strict=True)}
    checked = {method: error for method, error in checked.items() if not np.isnan(error)}
    if not checked:
        return BEST if BEST in methods else methods[0]
    least = min(checked, key=lambda method: checked[method])
    return BEST if BEST in checked and checked[BEST] * (1 - CHANCE) <= checked[least] else least


def curve(
    method: Method, drawing: NominalModel, learn: Sightings, held: Sightings, sizes: Sequence[int]
) -> list[float]:
    """Held-out error (RMS, m) after so many sightings, taken in the order in which they came."""
    return [rms(errors_m(fit(method, drawing, learn.pick(slice(size))), held)) for size in sizes if size <= len(learn)]
