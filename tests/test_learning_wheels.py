"""The distance between the wheels, from what was seen of a target before and after each trial."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apps.learning.dataset import WheelRow
from apps.learning.wheels import fit_wheels, separation_of, turn_between
from cocoro.frames import Pose2

TRUE_M = 0.2665
TARGET_M = (1.5, 0.0)


def drive(left_m: float, right_m: float, separation_m: float = TRUE_M) -> Pose2:
    """The pose of a body after its wheels have rolled so far."""
    turn = (right_m - left_m) / separation_m
    way = (left_m + right_m) / 2
    chord = way * (sin(turn / 2) / (turn / 2) if turn else 1.0)
    return Pose2(chord * cos(turn / 2), chord * sin(turn / 2), turn)


def trials(
    *, count: int = 40, seed: int = 0, scales: tuple[float, float] = (1.0, 1.0), noise: tuple[float, float] = (0.0, 0.0)
) -> Sequence[WheelRow]:
    """Forward and reverse pairs, as babbling makes them: `noise` of bearing (rad) and distance (m)."""
    rng = np.random.default_rng(seed)
    body = Pose2()
    found = []
    for number in range(count):
        if number % 2 == 0:
            left, right = rng.uniform(-0.15, 0.15, 2).tolist()
        else:
            left, right = -left, -right
        before = body.inverse().apply((*TARGET_M, 0.0))
        body = body.compose(drive(left * scales[0], right * scales[1]))
        after = body.inverse().apply((*TARGET_M, 0.0))
        seen = []
        for x, y, _ in (before, after):
            bearing, far = np.arctan2(y, x) + rng.normal(0, noise[0]), np.hypot(x, y) + rng.normal(0, noise[1])
            seen.append((far * cos(bearing), far * sin(bearing)))
        found.append(
            WheelRow(
                stamp_ns=number, trial=number, left_mps=left, right_mps=right, left_m=left, right_m=right,
                before_m=seen[0], after_m=seen[1], turned_rad=(right - left) / 0.261,
            )
        )  # fmt: skip
    return found


@given(left=st.floats(-0.2, 0.2), right=st.floats(-0.2, 0.2), x=st.floats(0.8, 2.0), y=st.floats(-0.5, 0.5))
def test_the_turn_is_found_with_the_arcs_translation_taken_out(left: float, right: float, x: float, y: float) -> None:
    after = drive(left, right).inverse().apply((x, y, 0.0))
    turn = turn_between((x, y), (after[0], after[1]), (left + right) / 2)
    assert turn == pytest.approx((right - left) / TRUE_M, abs=1e-9)


def test_without_noise_each_trial_gives_the_distance() -> None:
    estimates = [separation_of(trial) for trial in trials()]
    said = [value for value in estimates if value is not None]
    assert len(said) > 25
    assert said == pytest.approx([TRUE_M] * len(said))


def test_a_trial_that_hardly_turns_says_nothing() -> None:
    straight = WheelRow(
        stamp_ns=0, trial=0, left_mps=0.1, right_mps=0.101, left_m=0.1, right_m=0.101, before_m=(1.5, 0.0),
        after_m=(1.4, -0.005), turned_rad=0.0,
    )  # fmt: skip
    assert separation_of(straight) is None
    assert fit_wheels([straight]) is None
    assert fit_wheels([]) is None


def test_few_trials_give_their_median() -> None:
    fit = fit_wheels(trials(count=5)[:3])
    assert fit is not None
    assert fit.separation_m == fit.median_m == pytest.approx(TRUE_M)


@pytest.mark.parametrize("seed", range(8))
def test_with_noise_as_the_kinects_the_fit_is_within_three_millimetres(seed: int) -> None:
    fit = fit_wheels(trials(seed=seed, noise=(0.006, 0.006)))
    assert fit is not None
    assert fit.separation_m == pytest.approx(TRUE_M, abs=0.003)
    assert fit.separation_m == pytest.approx(TRUE_M, abs=4 * fit.sigma_m)


def test_the_fit_beats_the_papers_median() -> None:
    fits = [fit_wheels(trials(seed=seed, noise=(0.006, 0.006))) for seed in range(20)]
    off = np.array([(fit.separation_m - TRUE_M, fit.median_m - TRUE_M) for fit in fits if fit is not None])
    squares, median = np.sqrt((off**2).mean(axis=0))
    assert squares < median


def test_a_wrong_sighting_hardly_moves_it() -> None:
    rows = list(trials(noise=(0.002, 0.003)))
    wrong = rows[6]
    rows[6] = WheelRow(
        stamp_ns=wrong.stamp_ns, trial=wrong.trial, left_mps=wrong.left_mps, right_mps=wrong.right_mps,
        left_m=wrong.left_m, right_m=wrong.right_m, before_m=wrong.before_m, after_m=(0.9, 0.6), turned_rad=0.0,
    )  # fmt: skip
    fit = fit_wheels(rows)
    assert fit is not None
    assert fit.separation_m == pytest.approx(TRUE_M, abs=0.003)


def test_wheels_that_roll_unequally_far_are_told_from_the_distance() -> None:
    fit = fit_wheels(trials(scales=(1.015, 0.99), noise=(0.001, 0.001)))
    assert fit is not None
    assert fit.right_scale - fit.left_scale == pytest.approx(-0.025, abs=0.008)
    # The robot turns by the distance over the mean scale.
    assert fit.separation_m == pytest.approx(TRUE_M / 1.0025, abs=0.0015)
