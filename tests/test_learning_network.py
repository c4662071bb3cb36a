"""The network, its Jacobian, and the ways of setting its weights."""

from __future__ import annotations

import numpy as np
import pytest
from learning_arm import slope_by_differences

from apps.learning.rules import learn_in_order
from cocoro.learning.network import HyperplaneRbf, LeastSquares


@pytest.fixture
def network() -> HyperplaneRbf:
    rng = np.random.default_rng(1)
    made = HyperplaneRbf.spread([3, 2, 1, 3], [1.57, 1.0, 2.0, 1.2], np.tile([-2.62, 2.62], (4, 1)))
    made.weights = np.asarray(rng.normal(size=made.weights.shape))
    return made


def test_the_papers_network_has_81_bases_and_1215_weights() -> None:
    network = HyperplaneRbf.paper()
    assert network.bases == 81
    assert network.weights.size == 81 * 5 * 3
    assert np.ptp(network.centres, axis=0) == pytest.approx([5.24] * 4)


def test_one_output_is_the_equation_written_out(network: HyperplaneRbf) -> None:
    x = np.array([0.3, -1.0, 0.7, 2.0])
    total, given = np.zeros(()), np.zeros(3)
    for j, centre in enumerate(network.centres):
        c = (x - centre) / network.widths
        g = np.exp(-0.5 * c @ c)
        v = network.weights[network.bases + 4 * j : network.bases + 4 * (j + 1)]
        given += g * (network.weights[j] + c @ v)
        total += g
    assert np.allclose(network.at(x), given / total)


def test_the_jacobian_is_that_of_finite_differences_at_random_points(network: HyperplaneRbf) -> None:
    for x in np.random.default_rng(2).uniform(-3, 3, (50, 4)):
        assert np.allclose(network.jacobian(x), slope_by_differences(network, x), atol=1e-7)


def test_far_from_every_base_it_still_answers(network: HyperplaneRbf) -> None:
    far = np.full(4, 200.0)
    assert np.isfinite(network.at(far)).all()
    assert np.isfinite(network.jacobian(far)).all()


def test_in_order_is_the_papers_rule_sample_by_sample(network: HyperplaneRbf) -> None:
    rng = np.random.default_rng(3)
    inputs, targets = rng.uniform(-2, 2, (300, 4)), rng.normal(size=(300, 3))
    one_by_one = network.copy()
    for x, target in zip(inputs, targets, strict=True):
        one_by_one.learn(x, target, 0.1)
    learn_in_order(network, inputs, targets, 0.1)
    assert np.allclose(network.weights, one_by_one.weights, atol=1e-10)


def test_the_order_of_samples_matters_to_the_papers_rule_and_not_to_least_squares(network: HyperplaneRbf) -> None:
    rng = np.random.default_rng(4)
    inputs, targets = rng.uniform(-2, 2, (60, 4)), rng.normal(size=(60, 3))
    ways = []
    for order in (slice(None), slice(None, None, -1)):
        rule, squares = network.copy(), network.copy()
        learn_in_order(rule, inputs[order], targets[order], 0.3)
        learner = LeastSquares(squares)
        for x, target in zip(inputs[order], targets[order], strict=True):
            learner.add(x, target)
        ways.append((rule.weights, squares.weights))
    assert not np.allclose(ways[0][0], ways[1][0], atol=1e-3)
    assert np.allclose(ways[0][1], ways[1][1], atol=1e-8)


def test_least_squares_one_by_one_is_least_squares_all_at_once(network: HyperplaneRbf) -> None:
    rng = np.random.default_rng(5)
    inputs, targets = rng.uniform(-2, 2, (120, 4)), rng.normal(size=(120, 3))
    together = network.copy()
    LeastSquares(together, doubt=10.0).add_all(inputs, targets)
    learner = LeastSquares(network, doubt=10.0)
    for x, target in zip(inputs, targets, strict=True):
        learner.add(x, target)
    assert np.allclose(network.weights, together.weights, atol=1e-8)


def test_least_squares_goes_on_from_what_it_knew(network: HyperplaneRbf) -> None:
    rng = np.random.default_rng(6)
    inputs, targets = rng.uniform(-2, 2, (80, 4)), rng.normal(size=(80, 3))
    whole, parts = network.copy(), network.copy()
    LeastSquares(whole).add_all(inputs, targets)
    learner = LeastSquares(parts)
    learner.add_all(inputs[:50], targets[:50])
    learner.add_all(inputs[50:], targets[50:])
    assert np.allclose(whole.weights, parts.weights, atol=1e-7)


def test_widths_must_be_positive() -> None:
    with pytest.raises(ValueError, match="positive widths"):
        HyperplaneRbf(np.zeros((2, 4)), np.array([1.0, 1.0, 0.0, 1.0]), 3)
