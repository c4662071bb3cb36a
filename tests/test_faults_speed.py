"""Faults at full speed, at random moments: the body stands within 0.3 s, by the truth at every step of the physics.

Policies: docs/faults.md; two hundred of them: `python -m bench faults`.
"""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from functools import cache

import pytest

from bench.fault_robot import STAND_S, full_speed_mps
from bench.faults import HAPPENINGS, Trial, happening_of, run_trial
from deploy.processes import hardware

pytestmark = pytest.mark.sim

SEED = 1
"""With it every first scene lets the robot reach full speed; that one does not takes as long as ten trials to see."""


def telling(number: int) -> bool:
    """Whether a kind differs from the others enough to be tried at every change."""
    happening, _ = happening_of(number)
    dies_with_its_task = happening.way == "dies" and happening.service in hardware() and happening.service != "base"
    return happening.way != "late" and not dies_with_its_task


NUMBERS = [number for number in range(len(HAPPENINGS)) if telling(number)]


@cache
def trial_of(number: int) -> Trial:
    return run_trial(SEED, number)


@pytest.mark.parametrize("number", NUMBERS, ids=lambda number: happening_of(number)[0].name)
def test_whatever_happens_at_full_speed_the_robot_stands_in_time(number: int) -> None:
    trial = trial_of(number)
    assert trial.speed_mps >= 0.97 * full_speed_mps(trial.drive)
    assert trial.stand_s <= STAND_S, trial
    assert trial.stand_s > 0.1, "it was driving, and has a ramp"


@pytest.mark.process
def test_a_trial_is_the_same_again_in_another_process() -> None:
    number = NUMBERS[1]  # a short one
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        assert pool.submit(run_trial, SEED, number).result() == trial_of(number)
