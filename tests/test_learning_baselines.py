"""The baselines of learning: the readings of the paper's rule do what they say, and the rigid body is calibrated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from learning_arm import NOISE_M, sightings, slope_by_differences

from apps.experiments import e1_hand_eye_map, e2_reaching, e6_fetching
from apps.experiments.lessons import CURVES
from apps.experiments.plan import ExperimentSettings
from apps.learning import paper_rule, study
from apps.learning.calibration import CalibratedModel, as_map, calibrate
from apps.learning.paper_rule import (
    AS_PRINTED,
    AXES,
    IN_THE_LIBRARY,
    READINGS,
    SEARCHED,
    Reading,
    Statement,
    grid,
    reading,
    to_search,
)
from apps.learning.rules import learn_in_order
from apps.learning.sightings import Sightings
from apps.learning.study import METHODS, PAPER, PAPER_SEARCHED, RIGID, begin, errors_m, fit, rms, split
from cocoro.learning.handmap import NominalModel
from cocoro.learning.network import HyperplaneRbf
from cocoro.robot import Robot


@pytest.fixture(scope="module")
def nominal(robot: Robot) -> NominalModel:
    return NominalModel(robot)


@pytest.fixture(scope="module")
def seen(robot: Robot) -> Sightings:
    return sightings(robot, draws=60)


def changed(axis: str, name: str) -> Reading:
    """The best reading with another choice on one axis."""
    names = dict(zip(AXES, (choice.name for choice in AS_PRINTED.choices), strict=True)) | {axis: name}
    return reading(*names.values())


# --- readings ---------------------------------------------------------------------------------------


def test_every_choice_cites_the_text_or_says_what_it_decides_in_its_place() -> None:
    for choices in AXES.values():
        assert len(choices) > 1
        assert len({tuple(choice.fields.items()) for choice in choices}) == len(choices)
        for choice in choices:
            assert choice.agrees or choice.contradicts or choice.silent
            assert not set(choice.agrees) & set(choice.contradicts)
    cited = {statement for one in READINGS for statement in (*one.agrees, *one.contradicts)}
    assert cited | set(paper_rule.FOUND_AGAIN.agrees) == set(Statement)


def test_every_combination_is_read_once() -> None:
    sizes = [len(choices) for choices in AXES.values()]
    assert len({one.method for one in READINGS}) == len(READINGS) == np.prod(sizes)


def test_the_best_reading_contradicts_nothing_and_the_searched_one_says_what_it_contradicts() -> None:
    assert AS_PRINTED.contradicts == IN_THE_LIBRARY.contradicts == ()
    assert set(SEARCHED.contradicts) == {Statement.SPHERICAL, Statement.NUMBERS}
    assert set(AS_PRINTED.agrees) == set(Statement) - {Statement.SEARCH}
    assert set(changed("coordinates", "Cartesian").contradicts) == {Statement.SPHERICAL}
    assert set(changed("passes", "ten times").contradicts) == {Statement.ONCE}
    assert set(changed("priming", "not primed").contradicts) == {Statement.PRIMING, Statement.TENTH}


def test_the_texts_numbers_are_81_bases_and_its_rates(nominal: NominalModel) -> None:
    network = begin(AS_PRINTED.method, nominal)[0].network
    assert network.bases == 81
    assert network.widths == pytest.approx([1.57] * 4)
    assert AS_PRINTED.method.rate == 0.025
    assert AS_PRINTED.method.coordinates == "spherical"


def test_activations_are_the_gaussians_themselves_or_shares_of_their_sum(nominal: NominalModel) -> None:
    angles = np.random.default_rng(0).uniform(-2, 2, (5, 4))
    plain = begin(AS_PRINTED.method, nominal)[0].network
    shares = begin(changed("activation", "normalised").method, nominal)[0].network
    distance2 = (((angles[:, None] - plain.centres) / 1.57) ** 2).sum(axis=2)
    gaussians = np.exp(-distance2 / 2)
    assert np.allclose(plain.features(angles)[:, :81], gaussians)
    assert np.allclose(shares.features(angles)[:, :81], gaussians / gaussians.sum(axis=1, keepdims=True))
    whole = begin(changed("width", "σ whole").method, nominal)[0].network
    assert np.allclose(whole.features(angles)[:, :81], np.exp(-distance2))


def test_a_plain_networks_answers_and_jacobian_are_its_features_and_their_differences(nominal: NominalModel) -> None:
    network = HyperplaneRbf(np.random.default_rng(1).uniform(-2, 2, (7, 4)), np.full(4, 1.2), 3, normalised=False)
    network.weights = np.asarray(np.random.default_rng(2).normal(size=network.weights.shape))
    for angles in np.random.default_rng(3).uniform(-2, 2, (10, 4)):
        assert np.allclose(network.at(angles), network.predict(angles[None])[0])
        assert np.allclose(network.jacobian(angles), slope_by_differences(network, angles), atol=1e-7)
        assert not network.copy().normalised


def test_a_step_by_length_removes_its_share_of_the_error() -> None:
    rng = np.random.default_rng(4)
    network = HyperplaneRbf.paper()
    angles, target = rng.uniform(-2, 2, (1, 4)), np.array([[0.3, -0.2, 0.9]])
    learn_in_order(network, angles, target, 0.25, by_length=True)
    assert np.allclose(network.predict(angles), 0.25 * target)


def test_steps_by_length_are_the_same_in_blocks_as_one_by_one() -> None:
    rng = np.random.default_rng(5)
    inputs, targets = rng.uniform(-2, 2, (200, 4)), rng.normal(size=(200, 3))
    blocks, single = HyperplaneRbf.paper(), HyperplaneRbf.paper()
    learn_in_order(blocks, inputs, targets, 0.1, by_length=True)
    for x, target in zip(inputs, targets, strict=True):
        phi = single.features(x[None])[0]
        single.learn(x, target, 0.1 / float(phi @ phi))
    assert np.allclose(blocks.weights, single.weights, atol=1e-10)


def test_centres_are_at_the_ends_or_inside(nominal: NominalModel) -> None:
    ends = begin(AS_PRINTED.method, nominal)[0].network.centres
    inside = begin(changed("centres", "centres inside").method, nominal)[0].network.centres
    assert np.unique(ends.round(3)) == pytest.approx([-2.62, 0.0, 2.62])
    assert np.unique(inside.round(3)) == pytest.approx([-1.747, 0.0, 1.747])


def test_priming_is_shuffled_in_order_or_left_out(nominal: NominalModel) -> None:
    ordered, places = nominal.priming(shuffled=False)
    assert (np.diff(ordered[:, 0]) >= 0).all()
    assert np.allclose(places, nominal.predict(ordered))
    shuffled, _ = nominal.priming()
    assert np.array_equal(np.unique(shuffled, axis=0), np.unique(ordered, axis=0))
    assert not np.array_equal(shuffled, ordered)
    weights = [
        begin(changed("priming", name).method, nominal)[0].network.weights
        for name in ("primed shuffled", "primed in order", "not primed")
    ]
    assert not np.allclose(weights[0], weights[1])
    assert not weights[2].any()


def test_ten_passes_are_ten_times_one(nominal: NominalModel, seen: Sightings) -> None:
    method = replace(AS_PRINTED.method, passes=2)
    twice = fit(method, nominal, seen)
    once = fit(AS_PRINTED.method, nominal, seen)
    learn_in_order(once.network, seen.angles_rad, once.targets(seen.angles_rad, seen.places_m), method.rate)
    assert np.allclose(twice.network.weights, once.network.weights)


def test_the_search_takes_for_each_body_the_numbers_that_cross_validate_best(
    monkeypatch: pytest.MonkeyPatch, nominal: NominalModel, seen: Sightings
) -> None:
    monkeypatch.setattr(paper_rule, "GRID_BASES", (3,))
    monkeypatch.setattr(paper_rule, "GRID_SIGMA", (1.57,))
    monkeypatch.setattr(paper_rule, "GRID_RATE", (1e-4, 0.025, 50.0))  # too slow, the text's, diverging
    (found,) = study.search(AS_PRINTED, nominal, [seen])
    assert found.rate == 0.025
    assert Statement.SEARCH in found.agrees
    assert Statement.NUMBERS in found.contradicts
    assert len(list(grid(AS_PRINTED))) == 3
    assert all(not {Statement.ONCE, Statement.PRIMING} & set(one.contradicts) for one in to_search())


# --- the rigid body ---------------------------------------------------------------------------------


def test_a_calibrated_body_is_the_nominal_one_without_corrections(nominal: NominalModel) -> None:
    same = CalibratedModel(nominal, np.zeros(27))
    angles = np.random.default_rng(6).uniform(-1, 1, (10, 4))
    assert np.allclose(same.predict(angles), nominal.predict(angles))


def test_a_calibrated_bodys_answers_and_jacobian_agree(nominal: NominalModel) -> None:
    moved = CalibratedModel(nominal, np.random.default_rng(7).normal(0.0, 0.02, 27))
    for angles in np.random.default_rng(8).uniform(-1, 1, (5, 4)):
        assert np.allclose(moved.at(angles), moved.predict(angles[None])[0])
        assert np.allclose(moved.jacobian(angles), slope_by_differences(moved, angles), atol=1e-7)
        assert not np.allclose(moved.at(angles), nominal.at(angles), atol=1e-3)


def test_joint_zeros_are_found_where_nothing_else_is_wrong(nominal: NominalModel, seen: Sightings) -> None:
    zeros = np.zeros(27)
    zeros[5:24:6] = [0.03, -0.02, 0.025, -0.03]
    true = CalibratedModel(nominal, zeros)
    exact = Sightings(seen.angles_rad, true.predict(seen.angles_rad), seen.draws)
    left = rms(errors_m(calibrate(nominal, exact, "zeros"), exact))  # the prior keeps them a little too small
    assert left < 0.02 * rms(errors_m(nominal, exact))


def test_a_calibrated_body_comes_to_the_noise_of_what_was_seen(robot: Robot, nominal: NominalModel) -> None:
    learn, held = split(sightings(robot, draws=120, seed=2))
    errors = [rms(errors_m(calibrate(nominal, learn, freedom), held)) for freedom in ("zeros", "hand", "all")]
    assert errors[2] < 1.15 * NOISE_M
    assert errors[2] <= errors[1] < errors[0]


def test_the_planner_gets_the_calibrated_body_as_a_map(robot: Robot, nominal: NominalModel, seen: Sightings) -> None:
    body = calibrate(nominal, seen)
    hand = as_map(body, nominal)
    apart_m = np.linalg.norm(hand.predict(seen.angles_rad) - body.predict(seen.angles_rad), axis=1)
    assert float(np.median(apart_m)) < 2e-4


# --- the experiments --------------------------------------------------------------------------------


def test_the_experiments_compare_with_the_best_readings_and_with_the_calibrated_body(tmp_path: Path) -> None:
    assert replace(PAPER, name="") == replace(AS_PRINTED.method, name="")
    assert replace(PAPER_SEARCHED, name="") == replace(SEARCHED.method, name="")
    assert {PAPER, PAPER_SEARCHED} <= set(METHODS)
    assert {PAPER, PAPER_SEARCHED, RIGID[-1]} <= set(CURVES.values())
    settings = ExperimentSettings(seeds=(0,), out=tmp_path)
    for experiment in (e2_reaching, e6_fetching):
        models = {run.fields.get("model") for run in experiment.runs(settings) if run.kind == "rehearse"}
        assert {str(settings.model_file(0)), str(settings.rigid_file(0))} <= models
    lesson = {
        "arm": {"chosen": PAPER.name, "scores": [
            {"name": name, "held_out_m": error}
            for name, error in ((PAPER.name, 0.02), (RIGID[-1].name, 0.01),
                                ("the nominal model with its best constant offset", 0.04))
        ]},
        "readings": {"one": 0.05, "another": 0.03}, "curves": {key: {} for key in CURVES}, "draws_used": 1,
        "draws_looked_at": 2, "babbled_s": 60.0, "learn": 3,
    }  # fmt: skip
    results = {run.name: {"error": "none"} for run in e1_hand_eye_map.runs(settings)} | {"learn-0": lesson}
    shown = e1_hand_eye_map.section(settings, results).rows
    assert [row.values.mean for row in shown if "whichever allowed reading" in row.who] == [pytest.approx(3.0)]
    rows = {(row.measure, row.values.mean) for row in shown}
    assert (f"share of the error of: {PAPER.name}", 1.0) in rows
    assert (f"share of the error of: {RIGID[-1].name}", 2.0) in rows
