"""The hand-eye map learned on a known arm: what each way of learning comes to, and what it must not do."""

from __future__ import annotations

import numpy as np
import pytest
from learning_arm import NOISE_M, sightings, slope_by_differences

from apps.learning.method import Method
from apps.learning.rules import inliers
from apps.learning.sightings import Sightings
from apps.learning.study import (
    BEST,
    METHODS,
    PAPER,
    PAPER_LIBRARY,
    baselines,
    begin,
    best,
    clean,
    cross_validate,
    curve,
    errors_m,
    fit,
    grid,
    rms,
    score,
    split,
)
from cocoro.frames import to_spherical
from cocoro.learning.handmap import NominalModel, cartesian_of, spherical_of
from cocoro.robot import Robot


@pytest.fixture(scope="module")
def nominal(robot: Robot) -> NominalModel:
    return NominalModel(robot)


@pytest.fixture(scope="module")
def seen(robot: Robot) -> Sightings:
    return sightings(robot)


def test_the_drawing_is_the_robots_own_kinematics(robot: Robot, nominal: NominalModel) -> None:
    assert nominal.joints == ("arm_base", "shoulder", "elbow", "wrist_pitch")
    chain = robot.chain(robot.the_marker.link)
    angles = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 4))
    for row, place in zip(angles, nominal.predict(angles), strict=True):
        pose = chain.pose(dict(zip(nominal.joints, row, strict=True), wrist_roll=np.pi / 2))
        assert np.allclose(place, (pose @ [*robot.the_marker.position_m, 1.0])[:3])
        assert np.allclose(nominal.jacobian(row), slope_by_differences(nominal, row), atol=1e-7)


def test_priming_is_10_000_distinct_postures(nominal: NominalModel) -> None:
    angles, places = nominal.priming()
    assert angles.shape == (10_000, 4)
    assert places.shape == (10_000, 3)
    assert len(np.unique(angles.round(6), axis=0)) == 10_000
    assert [len(np.unique(angles[:, i].round(6))) for i in range(4)] == [10] * 4


def test_spherical_coordinates_are_those_of_the_common_frame() -> None:
    places = np.random.default_rng(0).normal(size=(20, 3))
    assert np.allclose(spherical_of(places), [to_spherical(place.tolist()) for place in places])
    assert np.allclose(cartesian_of(spherical_of(places)), places)


@pytest.mark.parametrize("method", [*METHODS[:3], BEST, METHODS[7]], ids=lambda method: method.name)
def test_every_maps_jacobian_is_that_of_finite_differences(
    method: Method, nominal: NominalModel, seen: Sightings
) -> None:
    learned = fit(method, nominal, seen)
    for angles in seen.angles_rad[::60]:
        assert np.allclose(learned.jacobian(angles), slope_by_differences(learned, angles), atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_over_the_drawing_the_map_comes_near_to_the_noise_of_what_was_seen(robot: Robot, seed: int) -> None:
    nominal = NominalModel(robot)
    learn, held = split(sightings(robot, seed=seed, draws=200))
    plain, shifted, *_ = baselines(nominal, learn, held)
    reached = score(BEST, nominal, learn, held)
    assert reached.held_out_m < 1.5 * NOISE_M
    assert reached.held_out_m < 0.6 * shifted.held_out_m < plain.held_out_m
    assert reached.cross_validated_m == pytest.approx(reached.held_out_m, rel=0.4)


def test_the_papers_rule_learns_and_least_squares_learns_more_of_the_same(
    nominal: NominalModel, seen: Sightings
) -> None:
    learn, held = split(seen)
    by_name = {method.name: method for method in METHODS}
    rule, squares = PAPER, by_name["81 bases, least squares"]
    untaught = rms(errors_m(begin(rule, nominal)[0], held))
    taught = rms(errors_m(fit(rule, nominal, learn), held))
    assert taught < untaught
    assert rms(errors_m(fit(squares, nominal, learn), held)) < 0.8 * taught
    assert taught < 0.3 * rms(errors_m(fit(PAPER_LIBRARY, nominal, learn), held))


def test_more_sightings_make_the_map_better(nominal: NominalModel, seen: Sightings) -> None:
    learn, held = split(seen)
    errors = curve(BEST, nominal, learn, held, (30, 100, 400, 100_000))
    assert len(errors) == 3
    assert errors[0] > errors[1] > errors[2]


def test_whole_draws_are_held_out(seen: Sightings) -> None:
    learn, held = split(seen)
    assert len(learn) + len(held) == len(seen)
    assert not set(learn.draws.tolist()) & set(held.draws.tolist())
    assert len(held) == pytest.approx(len(seen) / 5, rel=0.02)


def test_too_few_draws_cannot_be_cross_validated(nominal: NominalModel, seen: Sightings) -> None:
    assert np.isnan(cross_validate(BEST, nominal, seen.pick(seen.draws < 3)))


def test_the_best_is_the_one_of_the_smallest_cross_validated_error(nominal: NominalModel, seen: Sightings) -> None:
    learn, held = split(seen)
    methods = (PAPER, BEST)
    scores = [score(method, nominal, learn, held) for method in methods]
    assert best(scores, methods) is BEST
    assert best([s._replace(cross_validated_m=float("nan")) for s in scores], methods) is BEST


def test_the_grid_varies_bases_width_and_rate() -> None:
    methods = grid("in order")
    assert len(methods) == len({method.name for method in methods}) == 27
    assert {method.rate for method in methods} == {0.025, 0.1, 0.3}
    assert not any(method.over_nominal for method in methods)
    assert len({method.doubt for method in grid("least squares")}) == 3


def test_a_sighting_that_no_other_is_near_to_is_an_outlier(nominal: NominalModel, seen: Sightings) -> None:
    places = seen.places_m.copy()
    places[7] += [0.0, 0.0, 1.0]
    mask = inliers(places)
    assert not mask[7]
    assert mask.sum() > 0.98 * len(places)


def test_sparse_sightings_are_not_all_outliers() -> None:
    sparse = np.random.default_rng(0).uniform(0.0, 1.0, (40, 3))
    assert inliers(sparse).mean() > 0.9
    assert inliers(sparse[:1]).all()


def test_a_wrong_sighting_amidst_good_ones_is_found_by_its_error(nominal: NominalModel, seen: Sightings) -> None:
    places = seen.places_m.copy()
    places[[3, 90]] = places[[90, 3]]  # each where another truly was
    kept = clean(Sightings(seen.angles_rad, places, seen.draws), nominal)
    wrong = [row for row in (3, 90) if (kept.places_m == places[row]).all(axis=1).any()]
    assert not wrong
    assert len(kept) > 0.97 * len(seen)
