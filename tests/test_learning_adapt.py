"""A map that goes on learning: steady while the body is, quick when the body has changed."""

from __future__ import annotations

import numpy as np
import pytest
from learning_arm import sightings

from apps.learning.sightings import Sightings
from apps.learning.study import BEST, errors_m, fit, rms, split
from cocoro.learning.handmap import NominalModel
from cocoro.robot import Robot
from services.planning.teaching import Adapter
from sim.realism import BEND_RAD


@pytest.fixture(scope="module")
def parts(robot: Robot) -> tuple[Sightings, Sightings, Sightings]:
    """Split sightings into those to learn at first, to meet at work, and to hold out."""
    seen = sightings(robot, draws=300)
    learn, held = split(seen)
    return learn.pick(learn.draws < 160), learn.pick(learn.draws >= 160), held


def bent(robot: Robot, seen: Sightings) -> Sightings:
    nominal = NominalModel(robot)
    beyond = seen.angles_rad + np.array([0.0, 0.0, BEND_RAD, 0.0])
    shift = nominal.predict(beyond) - nominal.predict(seen.angles_rad)
    return Sightings(seen.angles_rad, seen.places_m + shift, seen.draws)


def test_nothing_is_lost_while_nothing_changes(robot: Robot, parts: tuple[Sightings, Sightings, Sightings]) -> None:
    learn, work, held = parts
    learned = fit(BEST, NominalModel(robot), learn)
    before = rms(errors_m(learned, held))
    adapter = Adapter(learned, before)
    for angles, place in zip(work.angles_rad, work.places_m, strict=True):
        adapter.add(angles, place)
    assert adapter.changes == 0
    assert rms(errors_m(adapter.map, held)) < 1.05 * before
    assert rms(errors_m(learned, held)) == before


def test_a_bent_arm_is_noticed_and_learned(robot: Robot, parts: tuple[Sightings, Sightings, Sightings]) -> None:
    learn, work, held = parts
    learned = fit(BEST, NominalModel(robot), learn)
    usual_m = rms(errors_m(learned, held))
    work, held = bent(robot, work), bent(robot, held)
    adapter = Adapter(learned, usual_m)
    errors = {0: rms(errors_m(learned, held))}
    for number, (angles, place) in enumerate(zip(work.angles_rad, work.places_m, strict=True), start=1):
        adapter.add(angles, place)
        if number in (50, 400):
            errors[number] = rms(errors_m(adapter.map, held))
    assert adapter.changes == 1
    assert errors[0] > 0.02
    assert errors[50] < 0.6 * errors[0]
    assert errors[400] < 0.25 * errors[0]


def test_what_is_not_the_hand_teaches_nothing(robot: Robot, parts: tuple[Sightings, Sightings, Sightings]) -> None:
    learn, work, _held = parts
    adapter = Adapter(fit(BEST, NominalModel(robot), learn), 0.003)
    weights = adapter.map.network.weights.copy()
    adapter.add(work.angles_rad[0], work.places_m[0] + 1.0)
    assert adapter.samples == 0
    assert np.array_equal(adapter.map.network.weights, weights)
