"""What the registers of a servo count in, by the protocol of its network.

Sources: ROBOTIS AX-12 manual; Feetech's memory table of the STS series (magnetic encoder).
"""

from __future__ import annotations

from math import pi, radians
from typing import Literal, NamedTuple

Protocol = Literal["dynamixel", "feetech"]


class ServoUnits(NamedTuple):
    """Units and ranges of a servo's registers."""

    counts: int
    """Positions are 0 to `counts` - 1."""
    count_rad: float
    """Unit of positions."""
    centre_count: float
    """The middle of the range."""
    speed_radps: float
    """Unit of speeds."""
    fastest: int
    """The highest speed that its register takes. 0 is no speed but the highest one."""
    full_torque: int
    """Load, and torque limit, at the stall torque."""


UNITS: dict[Protocol, ServoUnits] = {
    # 0 to 1023 are 0 to 300 degrees; speeds in 0.111 rpm.
    "dynamixel": ServoUnits(1024, radians(300.0) / 1023, 511.5, 0.111 * 2 * pi / 60, 1023, 1023),
    # 4096 steps a turn; speeds in steps per second (50 are 0.732 rpm), with the sign in bit 15; torque in 0.1 %.
    "feetech": ServoUnits(4096, 2 * pi / 4096, 2048.0, 2 * pi / 4096, 32767, 1000),
}
