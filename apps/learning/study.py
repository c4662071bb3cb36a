"""Comparison of methods for learning the hand-eye map: all are fitted to the same sightings and scored on others.

Whole draws of the babbling are held out, not single sightings: frames of one move are centimetres apart, so a map that
has learned one of them knows the next. The method is chosen by cross-validation on the draws that are not held out; the
held-out draws only measure the error.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from apps.learning import paper_rule
from apps.learning.calibration import CalibratedModel, Freedom, as_map, calibrate
from apps.learning.method import Method
from apps.learning.paper_rule import AS_PRINTED, IN_THE_LIBRARY, SEARCHED, Reading
from apps.learning.rules import folds, inliers, learn_in_order, plausible
from apps.learning.sightings import Sightings
from cocoro.arrays import FloatArray
from cocoro.learning.handmap import HandMap, NominalModel
from cocoro.learning.network import PAPER_RANGE_RAD, HyperplaneRbf, LeastSquares

PRIMING_SHARE = 0.1
"""Weight (or rate) of a priming point against a sighting."""
HELD_OUT = 5
"""Every fifth draw is held out."""
FOLDS = 4
CHANCE = 0.05
"""Relative difference of errors below which no method counts as better."""


BEST = Method("81 bases over the nominal model, least squares")
PAPER = replace(AS_PRINTED.method, name="the paper's rule, best reading of the text")
PAPER_SEARCHED = replace(SEARCHED.method, name="the paper's rule, its grid search made again")
PAPER_LIBRARY = replace(IN_THE_LIBRARY.method, name="the paper's rule, normalised as in its author's library")
METHODS: tuple[Method, ...] = (
    PAPER,
    PAPER_SEARCHED,
    PAPER_LIBRARY,
    Method("the paper's rule over the nominal model", "in order", normalised=False),
    Method("81 bases, least squares", over_nominal=False),
    Method("256 bases, least squares", over_nominal=False, bases=4, width_rad=1.05),
    BEST,
    Method("81 bases over the nominal model, spherical", coordinates="spherical"),
    Method("16 bases over the nominal model", bases=2, width_rad=2.5),
    Method("256 bases over the nominal model", bases=4, width_rad=1.05),
)
RIGID: tuple[Method, ...] = (
    Method("the rigid body, joint zeros calibrated", "rigid"),
    Method("the rigid body, zeros, hand and camera calibrated", "rigid"),
    Method("the rigid body, all calibrated", "rigid"),
)
"""The nominal model with a geometry fitted to the sightings (`apps.learning.calibration`), one for each freedom. They
are baselines: chosen for a model only when asked for by name."""
_FREEDOM: dict[str, Freedom] = dict(zip((method.name for method in RIGID), ("zeros", "hand", "all"), strict=True))


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
    if method.rule == "rigid":
        return as_map(calibrated(method, nominal, sightings), nominal)
    learned, learner = begin(method, nominal)
    targets = learned.targets(sightings.angles_rad, sightings.places_m)
    if learner is None:
        for _ in range(method.passes):
            learn_in_order(learned.network, sightings.angles_rad, targets, method.rate, by_length=method.by_length)
    else:
        learner.add_all(sightings.angles_rad, targets)
    return learned


def calibrated(method: Method, nominal: NominalModel, sightings: Sightings) -> CalibratedModel:
    """The rigid body of a method of `RIGID`."""
    return calibrate(nominal, sightings, _FREEDOM[method.name])


def begin(method: Method, nominal: NominalModel) -> tuple[HandMap, LeastSquares | None]:
    """A map without sightings, primed where it does not add to the nominal model, and its learner.

    The learner is None for the paper's rule, whose only state is the weights.
    """
    learned, learner = _primed(replace(method, name="", passes=1), nominal)  # neither matters to it
    network = learned.network.copy()
    return HandMap(
        nominal, network, over_nominal=method.over_nominal, coordinates=method.coordinates
    ), None if learner is None else learner.copy(network)


@lru_cache(maxsize=16)
def _primed(method: Method, nominal: NominalModel) -> tuple[HandMap, LeastSquares | None]:
    count = len(nominal.joints)
    reach_rad = PAPER_RANGE_RAD * (1.0 if method.centres == "at the ends" else 1.0 - 1.0 / method.bases)
    ranges = np.tile([-reach_rad, reach_rad], (count, 1))
    network = HyperplaneRbf.spread([method.bases] * count, [method.width_rad] * count, ranges)
    network.normalised = method.normalised
    learned = HandMap(nominal, network, over_nominal=method.over_nominal, coordinates=method.coordinates)
    learner = LeastSquares(network, method.doubt) if method.rule == "least squares" else None
    if not method.over_nominal and method.priming != "none":
        angles, places = nominal.priming(shuffled=method.priming == "shuffled")
        targets = learned.targets(angles, places)
        if learner is None:
            learn_in_order(network, angles, targets, PRIMING_SHARE * method.rate, by_length=method.by_length)
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
    """Scores of the rigid body: as drawn, with the constant offset that fits the sightings best, and with a fitted
    geometry (`RIGID`)."""
    offset = (learn.places_m - nominal.predict(learn.angles_rad)).mean(axis=0)
    moved = replace(held, places_m=held.places_m - offset)
    found = [
        ("the nominal model", errors_m(nominal, held), 0.0),
        ("the nominal model with its best constant offset", errors_m(nominal, moved), 0.0),
    ]
    for method in RIGID:
        started = time.process_time()
        body = calibrated(method, nominal, learn)
        found.append((method.name, errors_m(body, held), time.process_time() - started))
    return [
        Score(name, float("nan"), rms(errors), float(np.quantile(errors, 0.95)), took_s)
        for name, errors, took_s in found
    ]


def search(one: Reading, nominal: NominalModel, bodies: Sequence[Sightings]) -> list[Reading]:
    """The paper's grid search, for each of several bodies: the numbers with the least cross-validated error. A
    combination at which the rule diverges has lost."""
    candidates = list(paper_rule.grid(one))
    with np.errstate(all="ignore"):
        errors = [[cross_validate(other.method, nominal, learn) for learn in bodies] for other in candidates]
    return [candidates[int(row)] for row in np.nan_to_num(np.array(errors), nan=np.inf).argmin(axis=0)]


def grid(rule: Literal["in order", "least squares"]) -> Sequence[Method]:
    """The methods of a grid search."""
    found = []
    for bases in (2, 3, 4):
        for width in (1.0, 1.57, 2.2):
            if rule == "in order":
                for rate in (0.025, 0.1, 0.3):
                    name = f"{bases**4} bases, sigma {width:g}, rate {rate:g}"
                    found.append(
                        Method(name, rule, over_nominal=False, bases=bases, width_rad=width, rate=rate, by_length=True)
                    )
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
    model = calibrated if method.rule == "rigid" else fit
    parts = [learn.pick(slice(size)) for size in sizes if size <= len(learn)]
    return [rms(errors_m(model(method, nominal, part), held)) for part in parts]
