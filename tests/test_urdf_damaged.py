"""A damaged URDF makes a description that can be written, read and simulated, or is refused: nothing else happens."""

from __future__ import annotations

import random
import re
from math import cos, sin
from pathlib import Path

import pytest
from urdf_rig import DESK_ARM, desk_arm, rolling_arm, wheel

from apps.urdf.assumed import TORQUE_NM
from apps.urdf.describing import describe
from apps.urdf.writing import description_text, page_text
from cocoro.errors import ConfigError
from cocoro.robot import Robot
from sim.model import build_model

CART = rolling_arm("".join(wheel(f"w{turn}", 0.1 * sin(turn), -0.1 * cos(turn), turn) for turn in (0.0, 2.1, 4.2)))
NUMBERS = ("0", "-1", "1e20", "1e300", "1e-300", "nan", "3.14159", "1e5")
NAMES = ("", "body", "chassis", "mount", "caster_front", "upper", "swivel", "continuous", "fixed", "a|b", "\u2028")


def damaged(text: str, rng: random.Random) -> str:
    """A URDF with a few other values, without a few elements, or with a few characters changed."""
    for _ in range(rng.randint(1, 3)):
        way = rng.random()
        if way < 0.7:
            value = rng.choice(list(re.finditer(r'(\w+)="([^"]*)"', text)))
            words = value.group(2).split() or [""]
            is_number = value.group(1) not in ("name", "link", "type", "filename", "version")
            words[rng.randrange(len(words))] = rng.choice(NUMBERS if is_number else NAMES)
            text = text[: value.start(2)] + " ".join(words) + text[value.end(2) :]
        elif way < 0.9:
            element = rng.choice(list(re.finditer(r"<[^>]*/>", text)))
            text = text[: element.start()] + text[element.end() :]
        else:
            place = rng.randrange(len(text))
            text = text[:place] + rng.choice("<>/\"&'x") + text[place + rng.randint(0, 5) :]
    return text


@pytest.mark.sweep
@pytest.mark.parametrize("text", [DESK_ARM, CART], ids=["desk", "cart"])
def test_a_damaged_file_is_refused_or_makes_a_robot(tmp_path: Path, text: str) -> None:
    made, refusals = 0, []
    for seed in range(300):
        path = desk_arm(tmp_path, damaged(text, random.Random(seed)))
        try:
            result = describe(path, "desk")
        except ConfigError as error:
            refusals.append(str(error))
            continue
        made += 1
        file = tmp_path / "desk.toml"
        file.write_text(description_text(result.data, "desk.urdf"), encoding="utf-8")
        assert Robot.load(file).to_data() == result.robot.to_data(), seed
        assert "nan" not in build_model(result.robot).urdf, seed
        assert page_text("desk", "desk.urdf", result.missing)
    assert 30 < made < 270
    assert all(error.startswith(f"{tmp_path / 'desk.urdf'}: ") for error in refusals)
    assert [error for error in refusals if "the description made of it" in error] == []


@pytest.mark.parametrize(
    ("was", "becomes", "what"),
    [
        ('lower="-2" upper="1.8"', 'lower="-1e16" upper="1e16"', "limits of swivel, lift, bend, tilt, spin"),
        ('effort="3"', 'effort="0"', "torque of swivel, lift, bend, tilt, spin, left"),
        ('velocity="4"', "", "speed of swivel, lift, bend, tilt, spin, left"),
    ],
)
def test_limits_that_say_nothing_are_listed(tmp_path: Path, was: str, becomes: str, what: str) -> None:
    made = describe(desk_arm(tmp_path, DESK_ARM.replace(was, becomes)), "desk")
    assert what in {row.what for row in made.missing}


def test_a_torque_below_nothing_and_a_number_beyond_all_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="joint swivel: its effort is -3"):
        describe(desk_arm(tmp_path, DESK_ARM.replace('effort="3"', 'effort="-3"')), "desk")
    with pytest.raises(ConfigError, match="link foot: value='1e21' of <mass> is not a number, or too large"):
        describe(desk_arm(tmp_path, DESK_ARM.replace('value="1.5"', 'value="1e21"')), "desk")


def test_a_jaw_may_mimic_the_other_and_no_joint_of_the_arm_may(tmp_path: Path) -> None:
    led = DESK_ARM.replace(
        'effort="2" velocity="3"/>', 'effort="2" velocity="3"/><mimic joint="left" multiplier="-1"/>'
    )
    made = describe(desk_arm(tmp_path, led), "desk")
    assert set(made.robot.jaws) == {"left", "right"}
    assert any("right, which mimics left" in row.what for row in made.missing)
    arm = DESK_ARM.replace(
        '<joint name="bend" type="revolute">', '<joint name="bend" type="revolute"><mimic joint="lift"/>'
    )
    with pytest.raises(ConfigError, match="joint bend mimics lift"):
        describe(desk_arm(tmp_path, arm), "desk")


def test_a_pair_of_jaws_with_even_limits_opens_away_from_the_roll_axis(tmp_path: Path) -> None:
    even = DESK_ARM.replace('lower="-1.5" upper="0.2"', 'lower="-1" upper="1"')
    even = even.replace('lower="-0.2" upper="1.5"', 'lower="-1" upper="1"')
    signs = describe(desk_arm(tmp_path, DESK_ARM), "desk").robot.claw.open_sign
    assert describe(desk_arm(tmp_path, even), "desk").robot.claw.open_sign == signs


def test_a_torque_that_was_not_filled_in_is_not_believed(tmp_path: Path) -> None:
    made = describe(desk_arm(tmp_path, DESK_ARM.replace('effort="3"', 'effort="1000"')), "desk")
    assert made.robot.joints["lift"].torque_nm == TORQUE_NM
