"""What a base's wheels and the body's motion have to do with each other, whatever wheels it has.

`Base.drive` is the one of a description. Its kinematics are linear: a twist of the body is a speed of each wheel's rim,
and the reverse. So the same functions serve speeds, and the ways that wheels roll and the body moves in a short time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

from cocoro.messages import BaseCommand


class Twist(NamedTuple):
    """Motion of the body frame's origin in its plane: m/s and rad/s; of a time step, m and rad."""

    ahead: float = 0.0
    """Along the body frame's x axis."""
    turn: float = 0.0
    """Counter-clockwise."""
    aside: float = 0.0
    """To the left."""


class WheelDrive(ABC):
    """Kinematics of a base. The order of the wheels is that of `names`; a wheel's speed is that of its rim, m/s."""

    names: tuple[str, ...]
    """Of the wheels."""
    goes_aside: bool
    """Whether it can move to its sides."""
    in_step: bool
    """Whether its wheels change their speeds together, so that the body moves in the commanded direction meanwhile;
    otherwise each has its own ramp."""
    lever_m: float
    """Rim speed of the wheel that a turn on the spot moves fastest, by the turn rate, m."""

    @abstractmethod
    def wheels(self, twist: Twist) -> tuple[float, ...]:
        """The wheels that move the body so. Raises ValueError for what the base cannot do."""

    @abstractmethod
    def twist(self, wheels: Sequence[float]) -> Twist:
        """The body's motion that fits these wheels best (least squares)."""

    def slips(self, wheels: Sequence[float]) -> tuple[float, ...]:
        """By wheel, how much faster it turns than the motion that fits all wheels best has it. All are zero unless
        the base has more wheels than it can move in directions."""
        return tuple(wheel - fits for wheel, fits in zip(wheels, self.wheels(self.twist(wheels)), strict=True))

    def fastest(self, twist: Twist) -> float:
        """Speed of the fastest wheel, without its sign. Raises ValueError as `wheels` does."""
        return max(abs(speed) for speed in self.wheels(twist))

    def within(self, twist: Twist, limit: float) -> Twist:
        """The twist, scaled down until no wheel exceeds a limit: the direction and the arc stay as they are. Raises
        ValueError as `wheels` does."""
        fastest = self.fastest(twist)
        if fastest <= limit:
            return twist
        share = limit / fastest
        return Twist(share * twist.ahead, share * twist.turn, share * twist.aside)

    # --- commands -----------------------------------------------------------------------------------

    def wheels_of(self, command: BaseCommand) -> tuple[float, ...]:
        """The wheels' speeds, m/s, that a command asks for. Raises ValueError for what the base cannot do."""
        return self.wheels(Twist(command.ahead_mps, command.turn_radps, command.aside_mps))

    def command_of(self, wheels_mps: Sequence[float], stamp_ns: int = 0) -> BaseCommand:
        """The command that turns the wheels at these speeds."""
        ahead_mps, turn_radps, aside_mps = self.twist(wheels_mps)
        return BaseCommand(ahead_mps=ahead_mps, turn_radps=turn_radps, aside_mps=aside_mps, stamp_ns=stamp_ns)

    def fastest_mps(self, command: BaseCommand) -> float:
        """Speed of the fastest wheel, m/s, without its sign. Raises ValueError as `wheels_of` does."""
        return max(abs(speed_mps) for speed_mps in self.wheels_of(command))
