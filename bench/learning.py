"""Measures the cost of the hand-eye map on one core: priming, training, one Jacobian, one online sample, the mesh.

python bench/learning.py
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import timeit
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from apps.learning.rules import learn_in_order
from apps.learning.study import BEST, METHODS, Sightings, fit
from cocoro.learning.handmap import NominalModel
from cocoro.learning.network import PAPER_RATE, HyperplaneRbf, LeastSquares
from cocoro.robot import Robot
from services.planning.reachability import ReachMesh

SAMPLES = 1000


def best_s(call: Callable[[], object], number: int = 1, repeat: int = 5) -> float:
    """The least time of one call, since load can only add to it."""
    return min(timeit.repeat(call, number=number, repeat=repeat)) / number


def main() -> None:
    nominal = NominalModel(Robot.load())
    rng = np.random.default_rng(0)
    low, high = nominal.limits_rad.T
    angles = rng.uniform(low, high, (SAMPLES, 4))
    places = nominal.predict(angles) + rng.normal(0.0, 0.003, (SAMPLES, 3))
    seen = Sightings(angles, places, np.arange(SAMPLES) // 4)

    def paper() -> None:
        network = HyperplaneRbf.paper()
        learn_in_order(network, *nominal.priming(), PAPER_RATE / 10)
        learn_in_order(network, angles, places, PAPER_RATE)

    learned = fit(BEST, nominal, seen)
    plain = fit(METHODS[0], nominal, seen)
    learner = LeastSquares(HyperplaneRbf.paper())
    mesh = ReachMesh(places)
    asked = rng.uniform(-0.6, 0.9, (1000, 3))
    rows = (
        ("the paper's map: 10,000 priming points, then 1,000 samples in order", best_s(paper), "s", 2.0),
        ("the default map: 1,000 samples", best_s(lambda: fit(BEST, nominal, seen)), "s", None),
        ("one Jacobian, 81 bases", 1e6 * best_s(lambda: plain.jacobian(angles[0]), 20, 200), "us", 50.0),
        (
            "one Jacobian, 81 bases over the nominal model",
            1e6 * best_s(lambda: learned.jacobian(angles[0]), 20, 200),
            "us",
            None,
        ),
        ("one answer of the default map", 1e6 * best_s(lambda: learned.at(angles[0]), 20, 200), "us", None),
        (
            "one online sample, least squares",
            1e6 * best_s(lambda: learner.add(angles[0], places[0]), 20, 200),
            "us",
            None,
        ),
        ("reachability mesh over 1,000 places", 1e3 * best_s(lambda: ReachMesh(places)), "ms", None),
        ("1,000 reachability answers", 1e3 * best_s(lambda: mesh.verdicts(asked)), "ms", None),
    )
    for name, value, unit, limit in rows:
        verdict = "" if limit is None else f"  (at most {limit:g} {unit}: {'held' if value <= limit else 'MISSED'})"
        print(f"{name:<70} {value:8.3g} {unit}{verdict}")


if __name__ == "__main__":
    main()
