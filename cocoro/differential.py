"""Kinematics of a base with two driven wheels on one axle: a twist is a speed of each wheel, and the reverse."""

from __future__ import annotations

from cocoro.description import Base
from cocoro.messages import BaseCommand


def wheels_of(base: Base, command: BaseCommand) -> tuple[float, float]:
    """Speeds of the left and the right wheel, m/s, that move the body as commanded.

    Raises ValueError for a command to move aside, which such a base cannot do.
    """
    if command.aside_mps:
        raise ValueError(f"a base with two wheels cannot move aside, as commanded with {command.aside_mps:+.3f} m/s")
    half_mps = command.turn_radps * base.wheel_separation_m / 2
    return command.ahead_mps - half_mps, command.ahead_mps + half_mps


def command_of(base: Base, left_mps: float, right_mps: float, stamp_ns: int = 0) -> BaseCommand:
    """The command that turns the wheels at these speeds."""
    turn_radps = (right_mps - left_mps) / base.wheel_separation_m
    return BaseCommand(ahead_mps=(left_mps + right_mps) / 2, turn_radps=turn_radps, stamp_ns=stamp_ns)


def faster_mps(base: Base, command: BaseCommand) -> float:
    """Speed of the faster wheel, m/s, without its sign."""
    return max(abs(speed_mps) for speed_mps in wheels_of(base, command))
