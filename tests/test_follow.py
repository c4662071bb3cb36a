"""Pursuits: what counts as one, and the way round what stands between."""

from __future__ import annotations

from pathlib import Path

import pytest

from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from services.executive.tasks import FollowTask
from services.executive.tasks.follow import CATCH_UP_S, FRESH_S, WITHIN_M, Company

STEP_S = 0.1


def kept(company: Company, from_s: float, to_s: float, off_m: float, age_s: float = 0.05) -> None:
    for step in range(round((to_s - from_s) / STEP_S) + 1):
        company.note(off_m, age_s, from_s + step * STEP_S)


def test_the_time_counts_from_when_it_is_first_with_the_object() -> None:
    company = Company()
    kept(company, 0.0, 6.0, off_m=2.0)
    kept(company, 6.0, 12.0, off_m=0.1)
    assert company.share(12.0) == pytest.approx(1.0, abs=0.02)
    kept(company, 12.0, 18.0, off_m=1.0)
    assert company.share(18.0) == pytest.approx(0.5, abs=0.02)
    assert company.verdict(30.0).startswith(f"within {WITHIN_M:g} m of the wanted distance for 25% of 24 s")


def test_a_robot_that_never_catches_up_has_not_followed() -> None:
    company = Company()
    kept(company, 0.0, CATCH_UP_S - 1.0, off_m=1.0)
    assert "did not come within" in company.verdict(CATCH_UP_S - 1.0)
    kept(company, CATCH_UP_S - 1.0, 3 * CATCH_UP_S, off_m=1.0)
    assert company.verdict(3 * CATCH_UP_S)
    assert company.share(3 * CATCH_UP_S) == 0.0


def test_a_distance_that_is_only_remembered_is_not_kept() -> None:
    company = Company()
    kept(company, 0.0, 4.0, off_m=0.0)
    kept(company, 4.0, 12.0, off_m=0.0, age_s=FRESH_S + 0.1)
    assert company.share(12.0) == pytest.approx(1 / 3, abs=0.02)
    assert company.verdict(12.0)


def test_a_distance_that_no_newer_sighting_can_correct_is_kept() -> None:
    company = Company()
    for step in range(120):
        company.note(0.1, 1.05 + step % 10 * STEP_S, step * STEP_S)  # as with a perception that takes a second
    assert company.share(12.0) > 0.9
    kept(company, 12.0, 24.0, off_m=0.1, age_s=1.05 + FRESH_S + 0.1)
    assert company.share(24.0) == pytest.approx(0.5, abs=0.05)


@pytest.mark.sim
def test_a_ball_that_turns_a_corner_stays_in_sight_of_a_perception_that_takes_a_second() -> None:
    result = rehearse(
        RehearsalRequest(
            task=FollowTask(label="blue_ball", for_s=13.0), scene="follow", latency={"perception": 1.0},
            width=160, height=120, frame_rate_hz=15.0,
        )
    )  # fmt: skip
    assert (result["outcome"], result["reason"]) == ("done", "")
    truth = result["truth"]
    assert truth["contacts"] == 0
    assert truth["lost_s"] <= 1.0
    assert truth["near_share"] > 0.9


WALL = """
[[object]]
label = "blue_ball"
shape = "sphere"
radius_m = 0.04
position_m = [2.0, 0.0, 0.6]
floating = true
[[obstacle]]
shape = "box"
size_m = [0.1, 1.0, 0.5]
position_m = [0.85, 0.0]
"""


@pytest.mark.sim
def test_a_ball_behind_a_wall_is_followed_round_the_wall(tmp_path: Path) -> None:
    scene = tmp_path / "wall.toml"
    scene.write_text(WALL)
    task = FollowTask(label="blue_ball", for_s=12.0)
    result = rehearse(
        RehearsalRequest(task=task, scene=str(scene), width=160, height=120, frame_rate_hz=15.0, wait_s=0.5)
    )
    assert (result["outcome"], result["reason"]) == ("done", "")
    truth = result["truth"]
    assert truth["near_share"] > 0.8
    assert truth["near_share"] == pytest.approx(result["measures"]["near_share"], abs=0.1)
    assert (truth["contacts"], truth["stood_s"]) == (0, pytest.approx(0.0, abs=0.5))
