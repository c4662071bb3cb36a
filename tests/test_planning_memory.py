"""Target memory: where each object is believed to be, in the odometry frame."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.messages import TargetEstimate
from services.planning.config import MemoryConfig
from services.planning.memory import TargetMemory

HERE = Pose2()
CAN = np.array([1.0, 0.2, 0.06])
FRAME_S = 1 / 30


def feed(
    memory: TargetMemory,
    places: list[FloatArray],
    start_s: float = 0.0,
    period_s: float = FRAME_S,
    doubtful: bool = False,
    label: str = "can",
) -> float:
    """See it at each place, one a period; the time of the last sighting."""
    for number, place in enumerate(places):
        at_s = start_s + number * period_s
        memory.see(label, place, float(np.linalg.norm(place)), round(at_s * NS), doubtful=doubtful)
    return at_s


def believed(memory: TargetMemory, at_s: float, body: Pose2 = HERE) -> TargetEstimate:
    estimate = memory.estimate("can", body, round(at_s * NS))
    assert estimate is not None
    return estimate


def noisy(place: FloatArray, count: int, sigma_m: float, seed: int = 0) -> list[FloatArray]:
    return list(place + np.random.default_rng(seed).normal(0.0, sigma_m, (count, 3)))


def test_what_was_never_seen_is_not_known() -> None:
    memory = TargetMemory(MemoryConfig())
    assert memory.estimate("can", HERE, NS) is None
    assert memory.sightings("can") == 0
    assert memory.all(HERE, NS) == ()


@pytest.mark.parametrize("seed", range(5))
def test_noise_on_something_that_stands_is_smoothed_away_and_makes_it_no_mover(seed: int) -> None:
    memory = TargetMemory(MemoryConfig())
    end_s = feed(memory, noisy(CAN, 60, 0.01, seed))
    estimate = believed(memory, end_s)
    assert np.linalg.norm(np.array(estimate.position_m) - CAN) < 0.01
    assert np.linalg.norm(estimate.velocity_mps) < 0.05
    assert estimate.sigma_m < 0.01
    assert memory.sightings("can") == 60


@pytest.mark.parametrize("speed_mps", [0.1, 0.25, 0.35])
def test_the_velocity_of_something_that_moves_is_found_and_it_is_not_lagged_behind(speed_mps: float) -> None:
    memory, velocity = TargetMemory(MemoryConfig()), speed_mps * np.array([0.6, 0.8, 0.0])
    path = [place + velocity * k * FRAME_S for k, place in enumerate(noisy(CAN, 90, 0.005))]
    end_s = feed(memory, path)
    estimate = believed(memory, end_s)
    assert np.linalg.norm(np.array(estimate.velocity_mps) - velocity) < 0.25 * speed_mps + 0.03
    assert np.linalg.norm(np.array(estimate.position_m) - (CAN + velocity * end_s)) < 0.02


def test_what_stops_is_soon_believed_to_stand() -> None:
    memory, velocity = TargetMemory(MemoryConfig()), np.array([0.25, 0.0, 0.0])
    moving_s = feed(memory, [CAN + velocity * k * FRAME_S for k in range(60)])
    stopped = CAN + velocity * moving_s
    end_s = feed(memory, [stopped] * 45, start_s=moving_s + FRAME_S)
    estimate = believed(memory, end_s)
    assert np.linalg.norm(estimate.velocity_mps) < 0.06
    assert np.linalg.norm(np.array(estimate.position_m) - stopped) < 0.02


@pytest.mark.parametrize("count", [1, 2])
def test_a_stray_sighting_or_two_move_nothing(count: int) -> None:
    memory = TargetMemory(MemoryConfig())
    at_s = feed(memory, [CAN] * 30)
    at_s = feed(memory, [CAN + np.array([0.5, 0.0, 0.0])] * count, start_s=at_s + FRAME_S)
    assert np.array(believed(memory, at_s).position_m) == pytest.approx(CAN, abs=0.01)
    feed(memory, [CAN] * 3, start_s=at_s + FRAME_S)
    assert memory.sightings("can") == 33


def test_what_was_put_elsewhere_is_believed_when_three_sightings_agree() -> None:
    memory, elsewhere = TargetMemory(MemoryConfig()), CAN + np.array([0.5, 0.3, 0.0])
    at_s = feed(memory, [CAN] * 30)
    at_s = feed(memory, [elsewhere] * 3, start_s=at_s + FRAME_S)
    assert np.array(believed(memory, at_s).position_m) == pytest.approx(elsewhere, abs=0.01)


def test_sightings_that_do_not_agree_with_each_other_convince_nobody() -> None:
    memory = TargetMemory(MemoryConfig())
    at_s = feed(memory, [CAN] * 30)
    strays = [CAN + np.array([0.5 * (k + 1), (-1) ** k * 0.6, 0.0]) for k in range(6)]
    at_s = feed(memory, strays, start_s=at_s + FRAME_S)
    assert np.array(believed(memory, at_s).position_m) == pytest.approx(CAN, abs=0.02)


def test_doubtful_sightings_weigh_little_and_never_move_it_away() -> None:
    sure, unsure = TargetMemory(MemoryConfig()), TargetMemory(MemoryConfig())
    shifted = CAN + np.array([0.04, 0.0, 0.0])
    for memory, doubtful in ((sure, False), (unsure, True)):
        at_s = feed(memory, [CAN] * 30)
        at_s = feed(memory, [shifted] * 5, start_s=at_s + FRAME_S, doubtful=doubtful)
    drift = [abs(believed(memory, at_s).position_m[0] - CAN[0]) for memory in (sure, unsure)]
    assert drift[1] < 0.6 * drift[0]
    at_s = feed(unsure, [CAN + np.array([0.6, 0.0, 0.0])] * 10, start_s=at_s + FRAME_S, doubtful=True)
    assert believed(unsure, at_s).position_m[0] < CAN[0] + 0.05


@given(x=st.floats(-2, 2), y=st.floats(-2, 2), yaw=st.floats(-pi, pi))
def test_what_is_not_seen_is_carried_by_odometry(x: float, y: float, yaw: float) -> None:
    memory = TargetMemory(MemoryConfig())
    at_s = feed(memory, [CAN] * 10)
    body = Pose2(x, y, yaw)
    estimate = believed(memory, at_s + 1.0, body)
    assert body.apply(estimate.position_m) == pytest.approx(tuple(CAN), abs=0.01)
    assert estimate.odometry_position_m == pytest.approx(tuple(CAN), abs=0.01)


def test_the_longer_it_is_unseen_the_older_and_the_less_certain() -> None:
    memory = TargetMemory(MemoryConfig())
    at_s = feed(memory, [CAN] * 10)
    young, old = believed(memory, at_s + 0.5), believed(memory, at_s + 20.0)
    assert (young.age_s, old.age_s) == pytest.approx((0.5, 20.0))
    assert old.sigma_m > young.sigma_m


def test_an_unseen_movers_way_fades_out() -> None:
    memory, velocity, config = TargetMemory(MemoryConfig()), np.array([0.3, 0.0, 0.0]), MemoryConfig()
    at_s = feed(memory, [CAN + velocity * k * FRAME_S for k in range(60)])
    last = CAN + velocity * at_s
    far = believed(memory, at_s + 30.0).position_m[0] - last[0]
    assert far == pytest.approx(0.3 * config.velocity_fade_s, rel=0.3)


def test_what_was_not_seen_for_long_is_forgotten() -> None:
    memory = TargetMemory(MemoryConfig(forget_s=10.0))
    at_s = feed(memory, [CAN] * 10)
    assert memory.estimate("can", HERE, round((at_s + 9.9) * NS)) is not None
    assert memory.estimate("can", HERE, round((at_s + 10.1) * NS)) is None
    assert memory.sightings("can") == 0


def test_a_late_frame_changes_nothing() -> None:
    memory = TargetMemory(MemoryConfig())
    at_s = feed(memory, [CAN] * 10)
    before = believed(memory, at_s)
    feed(memory, [CAN + np.array([0.05, 0.0, 0.0])], start_s=at_s - 0.1)
    assert believed(memory, at_s) == before


def test_objects_are_remembered_apart() -> None:
    memory = TargetMemory(MemoryConfig())
    feed(memory, [CAN] * 5)
    at_s = feed(memory, [-CAN] * 5, label="ball")
    labels = [estimate.label for estimate in memory.all(HERE, round(at_s * NS))]
    assert labels == ["ball", "can"]
    memory.forget("can")
    assert [estimate.label for estimate in memory.all(HERE, round(at_s * NS))] == ["ball"]
    memory.clear()
    assert memory.all(HERE, round(at_s * NS)) == ()


@pytest.mark.parametrize("period_s", [1 / 30, 0.1, 0.5])
def test_at_any_rate_of_perception_a_standing_object_stands(period_s: float) -> None:
    memory = TargetMemory(MemoryConfig())
    end_s = feed(memory, noisy(CAN, 40, 0.01), period_s=period_s)
    estimate = believed(memory, end_s)
    assert np.linalg.norm(np.array(estimate.position_m) - CAN) < (0.012 if period_s < 0.3 else 0.02)
    assert np.linalg.norm(estimate.velocity_mps) < 0.06


def test_what_was_seen_in_an_object_s_place_under_another_label_before_is_forgotten() -> None:
    memory = TargetMemory(MemoryConfig())
    end_s = feed(memory, [CAN + np.array([0.02, 0.01, -0.02])] * 5, label="ball")
    feed(memory, [CAN] * 2, start_s=end_s + 1.0)
    assert memory.sure("ball"), "two sightings may be a mistake"
    feed(memory, [CAN], start_s=end_s + 2.0)
    assert memory.sightings("ball") == 0
    assert memory.sure("can")


def test_objects_side_by_side_or_on_one_another_are_both_remembered() -> None:
    memory = TargetMemory(MemoryConfig())
    feed(memory, [CAN + np.array([0.07, 0.0, 0.0])] * 5, label="neighbour")
    feed(memory, [CAN + np.array([0.0, 0.0, 0.12])] * 5, label="upper")
    feed(memory, [CAN] * 5, start_s=1.0)
    assert memory.sure("neighbour")
    assert memory.sure("upper")
    assert memory.sure("can")


def test_a_slow_perception_takes_no_velocity_from_what_moves() -> None:
    """Seen every 0.5 s, 0.5 s late: it was not unseen, and its velocity is the true one."""
    memory = TargetMemory(MemoryConfig())
    memory.sight_lag_s = 1.0
    for number in range(20):
        at_s = number * 0.5
        memory.see("ball", np.array([0.25 * at_s, 0.0, 0.7]), 1.0, round(at_s * NS), doubtful=False)
    estimate = memory.estimate("ball", Pose2(), round(10.4 * NS))
    assert estimate is not None
    assert estimate.velocity_mps[0] == pytest.approx(0.25, abs=0.005)
    assert estimate.odometry_position_m[0] == pytest.approx(0.25 * 10.4, abs=0.01)
    late = memory.estimate("ball", Pose2(), round(30.0 * NS))
    assert late is not None
    assert late.odometry_position_m[0] == pytest.approx(0.25 * (9.5 + 1.0 + 0.8), abs=0.02)


def test_a_part_of_a_thing_that_was_seen_whole_is_nothing_else() -> None:
    memory = TargetMemory(MemoryConfig())
    end_s = feed(memory, [CAN] * 10)
    end_s = feed(memory, [CAN] * 6, end_s + FRAME_S, doubtful=True, label="ball")
    assert memory.sightings("can") == 10
    assert memory.sightings("ball") == 0
    end_s = feed(memory, [CAN + np.array([0.3, 0.0, 0.0])] * 6, end_s + FRAME_S, doubtful=True, label="ball")
    assert memory.sightings("ball") == 6
    feed(memory, [CAN] * 4, end_s + FRAME_S, label="other")
    assert memory.sightings("can") == 0, "seen whole, it is the other one"
    assert (memory.whole("other"), memory.whole("ball"), memory.whole("can")) == (4, 0, 0)
