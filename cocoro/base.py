"""The table `[base]` of a robot description: the wheels that move the robot, and how long a command to them counts."""

from __future__ import annotations

from typing import Literal

import msgspec

from cocoro.differential import Differential
from cocoro.drive import WheelDrive
from cocoro.joints import ServoPlace
from cocoro.omni import Omni, OmniWheel
from cocoro.units import Positive


class Base(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    kind: Literal["differential", "omni"] = "differential"
    """Two wheels on one axle and casters, or three and more omni wheels that carry the robot."""
    wheel_separation_m: Positive | None = None
    """Of a differential base, which needs it."""
    wheel_radius_m: Positive | None = None
    """Of a differential base, which needs it."""
    wheel: tuple[OmniWheel, ...] = ()
    """Of an omni base, which needs three at least."""
    chassis_diameter_m: Positive
    """Of a round that holds everything at the height of the base, the wheels included."""
    chassis_height_m: Positive
    mass_kg: Positive
    max_wheel_speed_mps: Positive
    """Of every wheel's rim."""
    wheel_acceleration_mps2: Positive
    command_timeout_s: Positive
    """A wheel command is valid for at most this time, at any speed."""
    state_rate_hz: Positive
    stand_within_s: Positive = 0.3
    """The wheels stand within this time after the last command, from any speed."""
    stand_reserve_s: Positive = 0.03
    """The part of `stand_within_s` reserved for the delivery of a command, one period of the loop that notices the
    silence, and the body's lag behind the ramp of its wheels."""
    bumper: bool = True
    """Whether the front half of the chassis is a bumper with two switches, as a Create's."""

    def __post_init__(self) -> None:
        """Refuses a base that lacks what its kind needs, has what another kind needs, or cannot move."""
        axle = {"wheel_separation_m": self.wheel_separation_m, "wheel_radius_m": self.wheel_radius_m}
        has = [name for name, value in axle.items() if value is not None]
        if self.kind == "differential":
            if lacks := [name for name in axle if name not in has]:
                raise ValueError(f"kind = 'differential' needs {' and '.join(lacks)}")
            if self.wheel:
                raise ValueError("kind = 'differential' has no [[base.wheel]]; kind = 'omni' has")
            return
        if has:
            raise ValueError(f"kind = 'omni' has no {' and '.join(has)}: each [[base.wheel]] has its place and radius")
        names = [wheel.name for wheel in self.wheel]
        if twice := [name for number, name in enumerate(names) if name in names[:number]]:
            raise ValueError(f"two wheels are called {twice[0]!r}")
        if len(names) < 3:
            raise ValueError(f"kind = 'omni' needs three [[base.wheel]] at least, not {len(names)}")
        without = [wheel.name for wheel in self.wheel if wheel.servo is None]
        if without and len(without) < len(names):
            raise ValueError(f"wheel {without[0]} has no servo, but others have: servos turn all wheels or none")
        Omni(self.wheel)

    @property
    def drive(self) -> WheelDrive:
        """Its kinematics."""
        return Omni(self.wheel) if self.kind == "omni" else Differential(self.axle_m)

    @property
    def servo_places(self) -> tuple[ServoPlace, ...]:
        """The servos that turn its wheels, in the order of `drive`; none where something else does."""
        servos = ((wheel.name, wheel.servo) for wheel in self.wheel)
        return tuple(ServoPlace("wheel", name, one.network, one.id) for name, one in servos if one is not None)

    @property
    def axle_m(self) -> float:
        """Distance of the two wheels. Raises ValueError for a base that is not differential."""
        if self.wheel_separation_m is None:
            raise ValueError(f"a base of the kind {self.kind!r} has no two wheels on one axle")
        return self.wheel_separation_m

    def patience_s(self, speed_mps: float) -> float:
        """The age up to which a command counts when it turns the fastest wheel at this speed; the ramp down to standing
        takes the rest of `stand_within_s`."""
        ramp_s = abs(speed_mps) / self.wheel_acceleration_mps2
        return max(min(self.command_timeout_s, self.stand_within_s - self.stand_reserve_s - ramp_s), 0.0)

    def speed_at_age_mps(self, age_s: float) -> float:
        """The highest wheel speed from which the base still stands in time when the last command has this age."""
        ramp_s = self.stand_within_s - self.stand_reserve_s - age_s
        return max(ramp_s, 0.0) * self.wheel_acceleration_mps2
