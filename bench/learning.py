"""Measures learning the hand-eye map: the error after a number of sightings, and the time of each step.

The times are of one core, and what is compared takes turns. The sightings are a worn body's, in virtual time.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from argparse import Namespace
from collections.abc import Callable

import numpy as np

from apps.learning import study
from apps.learning.calibration import calibrate
from apps.learning.rules import learn_in_order
from apps.learning.sightings import Sightings
from apps.learning.study import BEST, PAPER, RIGID
from bench.bodies import FEW, MANY, SEEDS, babble
from bench.report import Chart, Report, Series, timed, turns
from cocoro.learning.handmap import NominalModel
from cocoro.learning.network import LeastSquares
from cocoro.robot import Robot
from services.planning.reachability import ReachMesh

CALLS = 50
"""Calls in a sample of a time that is a few microseconds."""
ASKED = 1000
"""Positions in a question to the mesh."""
SIZES = (30, 100, 300, 1000)


def measure(chosen: Namespace, report: Report) -> None:
    """The short form has fewer sightings and fewer rounds."""
    robot = Robot.load()
    nominal = NominalModel(robot)
    report.say(f"body {SEEDS[0]} babbles")
    seen = babble(SEEDS[0], FEW if chosen.short else MANY, robot)
    learn, held = study.split(seen)
    errors(nominal, learn, held, report)
    rounds = 5 if chosen.short else 20
    times_of_a_sighting(nominal, learn, report, rounds)
    times_of_a_body(nominal, seen.pick(slice(FEW)), report, rounds // 5)


def errors(nominal: NominalModel, learn: Sightings, held: Sightings, report: Report) -> None:
    """Held-out error after the first so many sightings."""
    lines = {
        "ours, 81 bases over the nominal model": BEST,
        RIGID[-1].name: RIGID[-1],
        PAPER.name: PAPER,
    }
    sizes = [*(size for size in SIZES if size < len(learn)), len(learn)]
    series = []
    for name, method in lines.items():
        found_mm = [1000 * error for error in study.curve(method, nominal, learn, held, sizes)]
        series.append(Series(name, [(size, mm, mm, mm) for size, mm in zip(sizes, found_mm, strict=True)]))
        for size, mm in zip(sizes, found_mm, strict=True):
            report.value(f"{name}: held-out error after {size} sightings", [mm], "mm")
    report.charts.append(
        Chart("error", "Error of the hand-eye map on draws that it has not seen", "sightings", "RMS error, mm", series,
              log_x=True, log_y=True)
    )  # fmt: skip


def times_of_a_sighting(nominal: NominalModel, learn: Sightings, report: Report, rounds: int) -> None:
    """What happens for each sighting and in each step of the planner."""
    learned, paper = study.fit(BEST, nominal, learn), study.fit(PAPER, nominal, learn)
    learner = LeastSquares(learned.network.copy())
    angles, place = learn.angles_rad[0], learn.places_m[0]
    rule = paper.network.copy()
    things: dict[str, Callable[[], object]] = {
        "prediction": lambda: learned.at(angles),
        "nominal": lambda: nominal.at(angles),
        "jacobian": lambda: learned.jacobian(angles),
        "network_jacobian": lambda: learned.network.jacobian(angles),
        "nominal_jacobian": lambda: nominal.jacobian(angles),
        "update": lambda: learner.add(angles, place),
        "rule": lambda: rule.learn(angles, place, 1e-3),
    }
    measured = turns(rounds, 1, **{name: timed(_often(thing), "us") for name, thing in things.items()})
    us = {name: [value / CALLS for value in values] for name, values in zip(things, measured, strict=True)}
    report.value("a prediction of the learned map", us["prediction"], "us")
    report.value("its Jacobian", us["jacobian"], "us")
    report.value("the Jacobian of its 81 bases alone", us["network_jacobian"], "us", at_most=50.0)
    report.value("learning one sighting, least squares", us["update"], "us")
    report.value("learning one sighting, the paper's rule", us["rule"], "us")
    report.ratio("a prediction: learned map / nominal model", us["prediction"], us["nominal"], better="less")
    report.ratio("a Jacobian: learned map / nominal model", us["jacobian"], us["nominal_jacobian"], better="less")
    report.ratio("one sighting: least squares / the paper's rule", us["update"], us["rule"], better="less")


def _often(thing: Callable[[], object]) -> Callable[[], None]:
    def call() -> None:
        for _ in range(CALLS):
            thing()

    return call


def times_of_a_body(nominal: NominalModel, seen: Sightings, report: Report, rounds: int) -> None:
    """What happens once for a body's sightings."""
    targets = seen.places_m - nominal.predict(seen.angles_rad)
    asked = np.random.default_rng(0).uniform(-0.6, 0.9, (ASKED, 3))
    mesh = ReachMesh(seen.places_m)

    def one_by_one() -> None:
        learner = LeastSquares(study.begin(BEST, nominal)[0].network)
        for angles, target in zip(seen.angles_rad, targets, strict=True):
            learner.add(angles, target)

    def primed() -> None:
        network = study.begin(PAPER, nominal)[0].network
        network.weights[:] = 0.0
        learn_in_order(network, *nominal.priming(), PAPER.rate / 10)

    batch, online, paper, priming, rigid, build, ask = turns(
        rounds,
        batch=timed(lambda: study.fit(BEST, nominal, seen)),
        online=timed(one_by_one),
        paper=timed(lambda: study.fit(PAPER, nominal, seen)),
        priming=timed(primed),
        rigid=timed(lambda: calibrate(nominal, seen)),
        build=timed(lambda: ReachMesh(seen.places_m)),
        ask=timed(lambda: mesh.verdicts(asked)),
    )
    count = len(seen)
    report.value(f"fitting {count} sightings at once", batch, "ms")
    report.value(f"learning {count} sightings one by one", online, "ms")
    report.value(f"the paper's rule, {count} sightings once", paper, "ms")
    report.value("priming the paper's network with 10,000 postures", priming, "ms", at_most=2000.0)
    report.value(f"calibrating the rigid body by {count} sightings", rigid, "ms")
    report.value(f"the reachability mesh over {count} positions", build, "ms")
    report.value(f"{ASKED} questions to it", ask, "ms")
    report.ratio(f"{count} sightings: one by one / at once", online, batch, better="less")
    report.ratio(f"{count} sightings: calibrating the rigid body / fitting the map", rigid, batch, better="more")
