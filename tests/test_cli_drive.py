"""`cocoro drive`: what its keys mean, and where it does not begin."""

from __future__ import annotations

import pytest

from apps.cli.drive import LEAST_MPS, MOST_MPS, Keys
from apps.cli.main import main
from apps.cli.task_commands import RehearsalGroup, task_names
from cocoro.messages import Motion


def test_a_key_of_the_base_has_the_chosen_speed_and_arrows_mean_the_same() -> None:
    keys = Keys(0.3)
    assert keys.motion("w") == keys.motion("\x1b[A") == Motion(speed_mps=0.3)
    assert keys.motion("s") == keys.motion("\x1bOB") == Motion(speed_mps=-0.3)
    left, right = keys.motion("a"), keys.motion("d")
    assert left is not None
    assert right is not None
    assert left.turn_radps == -right.turn_radps > 0
    assert keys.motion("\x1b[D") == left


def test_plus_and_minus_change_the_speed_within_its_limits() -> None:
    keys = Keys(0.3)
    keys.change_speed("+")
    assert keys.speed_mps > 0.3
    for _ in range(50):
        keys.change_speed("-")
    assert keys.speed_mps == LEAST_MPS
    for _ in range(50):
        keys.change_speed("=")
    assert keys.speed_mps == MOST_MPS


def test_space_means_rest_and_an_unknown_key_nothing() -> None:
    assert Keys(0.3).motion(" ") == Motion()
    assert Keys(0.3).motion("?") is None


def test_every_part_has_two_keys_that_move_it_in_opposite_directions() -> None:
    keys = Keys(0.3)
    for one, other in (",.", "ik", "jl", "tg", "rf", "zx", "vb"):
        forth, back = keys.motion(one), keys.motion(other)
        assert forth is not None
        assert back is not None
        sums = [getattr(forth, name) + getattr(back, name) for name in Motion.__struct_fields__ if name.endswith("ps")]
        assert sums == [0.0] * len(sums)
        assert not forth.zero


def test_without_a_terminal_it_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["drive"]) == 2
    assert "terminal" in capsys.readouterr().err


def test_it_is_a_command_of_its_own_and_cannot_be_rehearsed(capsys: pytest.CaptureFixture[str]) -> None:
    assert "drive" not in task_names()
    assert "drive" not in RehearsalGroup().list_commands(None)
    assert main(["rehearse", "drive"]) == 2
    assert "no task 'drive'" in capsys.readouterr().err
