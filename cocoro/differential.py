"""Kinematics of a base with two driven wheels on one axle: a twist is a speed of each wheel, and the reverse."""

from __future__ import annotations

from collections.abc import Sequence

from cocoro.drive import Twist, WheelDrive


class Differential(WheelDrive):
    """Two wheels, `separation_m` apart."""

    names = ("left", "right")
    goes_aside = False
    in_step = False  # as a Create: it ramps each wheel by itself

    def __init__(self, separation_m: float) -> None:
        self.separation_m = separation_m
        self.lever_m = separation_m / 2

    def wheels(self, twist: Twist) -> tuple[float, float]:
        """Left and right. Raises ValueError for a motion aside, which such a base cannot make."""
        if twist.aside:
            raise ValueError(f"a base with two wheels cannot move aside, as commanded with {twist.aside:+.3f} m/s")
        half = twist.turn * self.separation_m / 2
        return twist.ahead - half, twist.ahead + half

    def twist(self, wheels: Sequence[float]) -> Twist:
        left, right = wheels
        return Twist((left + right) / 2, (right - left) / self.separation_m)
