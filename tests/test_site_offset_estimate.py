"""The estimate of another host's clock: within its own bounds under jitter, loss, drift and clocks that are set."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from cocoro.clock import NS
from deploy.site.offset_estimate import (
    PPM,
    SLEW_PPM,
    UNKNOWN_PPM,
    Estimate,
    OffsetEstimator,
    Trust,
    correction_ns,
    sample,
)

MS = NS // 1000
Delay = Callable[[random.Random], tuple[float, float]]
"""Of the ways there and back, s."""


class Pair:
    """This machine's steady clock, and another's time, `ahead_s` ahead at first and drifting."""

    def __init__(self, delay: Delay, *, ahead_s: float = 1e9, ppm: float = 0.0, loss: float = 0.0) -> None:
        self.estimator = OffsetEstimator()
        self.random = random.Random(3)
        self.delay, self.loss = delay, loss
        self.ahead_ns, self.ppm = round(ahead_s * NS), ppm
        self.now_ns = 1_000 * NS
        self._begun_ns = self.now_ns

    def truth_ns(self, at_ns: int) -> int:
        return self.ahead_ns + round(self.ppm * PPM * (at_ns - self._begun_ns))

    def exchange(self) -> None:
        there, back = (round(way * NS) for way in self.delay(self.random))
        if self.random.random() >= self.loss:
            sent, received, answered = self.now_ns, self.now_ns + there, self.now_ns + there + 50_000
            arrived = answered + back
            made = sample(sent, received + self.truth_ns(received), answered + self.truth_ns(answered), arrived)
            assert made is not None
            self.estimator.add(made)
        self.now_ns += NS // 4

    def run(self, seconds: float) -> None:
        for _ in range(round(4 * seconds)):
            self.exchange()

    @property
    def estimate(self) -> Estimate:
        found = self.estimator.at(self.now_ns)
        assert found is not None
        return found

    @property
    def error_ns(self) -> float:
        return self.estimate.ahead_ns - self.truth_ns(self.now_ns)


def even(_: random.Random) -> tuple[float, float]:
    return 0.001, 0.001


def jittery(chance: random.Random) -> tuple[float, float]:
    return 0.001 + chance.expovariate(1 / 0.004), 0.001 + chance.expovariate(1 / 0.004)


def one_sided(chance: random.Random) -> tuple[float, float]:
    """All the jitter is on the way there, up to 30 ms."""
    return 0.001 + 0.03 * chance.random(), 0.001


def lopsided(_: random.Random) -> tuple[float, float]:
    """The worst case: no exchange shows that one way takes all the time."""
    return 0.008, 0.0


def test_nothing_is_known_before_the_first_answer() -> None:
    assert OffsetEstimator().at(NS) is None


def test_stamps_that_contradict_themselves_are_no_sample() -> None:
    assert sample(0, 10, 5, 20) is None
    assert sample(0, 0, 100, 20) is None


@pytest.mark.parametrize("delay", [even, jittery, one_sided, lopsided])
@pytest.mark.parametrize("ppm", [-60.0, 0.0, 20.0])
@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_the_truth_is_within_the_stated_uncertainty_at_any_time(delay: Delay, ppm: float, loss: float) -> None:
    pair = Pair(delay, ppm=ppm, loss=loss)
    pair.run(5)
    for _ in range(4 * 300):
        pair.exchange()
        assert abs(pair.error_ns) <= pair.estimate.uncertainty_ns + 1


@pytest.mark.parametrize(("delay", "within_ms"), [(even, 0.1), (jittery, 1.5), (one_sided, 2.0)])
def test_the_best_exchange_of_some_seconds_decides(delay: Delay, within_ms: float) -> None:
    pair = Pair(delay, ppm=20.0)
    pair.run(60)
    worst_ns = 0.0
    for _ in range(4 * 240):
        pair.exchange()
        worst_ns = max(worst_ns, abs(pair.error_ns))
    assert worst_ns < within_ms * MS


@pytest.mark.parametrize(("delay", "within_ppm"), [(even, 0.5), (jittery, 5.0), (one_sided, 8.0)])
@pytest.mark.parametrize("ppm", [-60.0, 12.0])
def test_the_drift_is_found_within_minutes(delay: Delay, within_ppm: float, ppm: float) -> None:
    pair = Pair(delay, ppm=ppm)
    known = []
    for seconds in (20, 240):
        pair.run(seconds)
        known.append(pair.estimate.slope_known)
    assert known == [False, True]
    assert pair.estimate.slope / PPM == pytest.approx(ppm, abs=within_ppm)


def test_without_answers_the_uncertainty_grows_as_the_drift_may() -> None:
    pair = Pair(even)
    pair.run(5)
    before = pair.estimate
    pair.now_ns += 100 * NS
    grown_ns = pair.estimate.uncertainty_ns - before.uncertainty_ns
    assert grown_ns == pytest.approx(UNKNOWN_PPM * PPM * 100 * NS, rel=0.01)


@pytest.mark.parametrize("step_s", [-3600.0, -0.02, 0.02, 3600.0])
def test_a_clock_that_is_set_is_followed_after_three_answers_that_agree(step_s: float) -> None:
    pair = Pair(jittery, ppm=20.0)
    pair.delay = even
    pair.run(120)
    pair.ahead_ns += round(step_s * NS)
    pair.exchange()
    pair.exchange()
    assert abs(pair.error_ns) > 0.9 * abs(step_s) * NS, "two answers may be wrong"
    pair.exchange()
    assert abs(pair.error_ns) < MS
    assert pair.estimator.restarts == 1
    assert not pair.estimate.slope_known


def test_answers_that_contradict_everything_move_nothing() -> None:
    pair = Pair(even)
    pair.run(30)
    for number in range(20):
        pair.ahead_ns += (number + 1) * NS
        pair.exchange()
        pair.ahead_ns -= (number + 1) * NS
    assert abs(pair.error_ns) < MS
    assert pair.estimator.restarts == 0


def test_a_correction_is_bounded_and_settles() -> None:
    passed = NS // 4
    assert correction_ns(10 * NS, 0.0, passed) == round(SLEW_PPM * PPM * passed)
    assert correction_ns(-10 * NS, 0.0, passed) == -round(SLEW_PPM * PPM * passed)
    assert correction_ns(0.0, 20 * PPM, passed) == round(20 * PPM * passed)
    left_ns = 2.0 * MS
    for _ in range(4 * 60):
        left_ns -= correction_ns(left_ns, 0.0, passed)
    assert abs(left_ns) < 0.01 * MS


def test_trust_needs_several_looks_and_admits_below_the_limit_that_it_refuses_at() -> None:
    trust = Trust(25.0)
    for bound in (30.0, 30.0, 10.0, 30.0, 30.0):
        trust.look(bound)
        assert not trust.refused
    trust.look(30.0)
    assert trust.refused
    for _ in range(100):
        trust.look(20.0)
    assert trust.refused, "below the limit, but not far enough"
    for _ in range(Trust.ADMITTED_AFTER):
        assert trust.refused
        trust.look(14.0)
    assert not trust.refused


def test_a_clock_that_was_never_compared_is_refused_at_once() -> None:
    trust = Trust(25.0)
    trust.refuse()
    assert trust.refused
