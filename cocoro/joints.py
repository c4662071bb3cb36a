"""The joints of a robot description, the serial lines that carry their servos, and the groups that commands address.

A line (`[network.NAME]`) is a wire with servos on it. A group is what one pair of topics commands: `arm` has the joints
that bring the hand and the camera to a place, `hand` turns and closes the hand. The group follows from what a joint is
for, so one line can carry both, and joints of neither.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from math import radians
from typing import Annotated, Literal, NamedTuple

import msgspec
from msgspec import Meta

from cocoro.servo_units import UNITS, Protocol, ServoUnits
from cocoro.units import Positive

Group = Literal["arm", "hand"]
GROUPS: tuple[Group, ...] = ("arm", "hand")
KEEPS_GOAL: frozenset[Group] = frozenset({"hand"})
"""Groups whose joints keep their goals when commands cease, so that a held thing stays held. The others hold where they
are."""

LineName = Annotated[str, Meta(pattern="^[a-z][a-z0-9_]*$")]
"""It is also the name of the line's port."""


class Network(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One serial line of servos."""

    baud: int
    rate_hz: Positive
    command_timeout_s: Positive
    """A command to these joints is valid for this time."""
    protocol: Protocol = "dynamixel"
    """What its servos speak."""


class JointRow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    network: str
    """The line that its servo is on."""
    id: int
    limits_deg: tuple[float, float]
    torque_nm: Positive
    max_speed_radps: Positive
    compliance_deg: Annotated[float, Meta(ge=0)] = 0.0
    """Distance from the goal beyond which the servo pushes with all of `torque_nm`; 0: always."""
    overload_s: Positive = 5.0
    """A servo that pushes at its limit for this long is overloaded."""
    direction: Literal[-1, 1] = 1
    centre_count: float | None = None
    """The servo's position at the joint's angle 0; by default the middle of the servo's range."""

    def __post_init__(self) -> None:
        if not self.limits_deg[0] < self.limits_deg[1]:
            raise ValueError(f"joint {self.name}: limits_deg must rise, not {self.limits_deg}")

    @property
    def limits_rad(self) -> tuple[float, float]:
        return radians(self.limits_deg[0]), radians(self.limits_deg[1])


class Joint(JointRow, frozen=True):
    """A row of the description with what follows from its line's protocol and from what it is for."""

    centre_count: float = UNITS["dynamixel"].centre_count
    units: ServoUnits = UNITS["dynamixel"]
    group: Group | None = None
    """None: no command addresses it."""

    @classmethod
    def of(cls, row: JointRow, protocol: Protocol, group: Group | None = None) -> Joint:
        units = UNITS[protocol]
        centre_count = units.centre_count if row.centre_count is None else row.centre_count
        return cls(**{**msgspec.structs.asdict(row), "centre_count": centre_count, "units": units, "group": group})

    def to_count(self, angle_rad: float) -> int:
        """The servo position nearest to a joint angle (radians), clipped to the servo's range."""
        count = round(self.centre_count + self.direction * angle_rad / self.units.count_rad)
        return min(max(count, 0), self.units.counts - 1)

    def to_angle(self, count: float) -> float:
        """The joint angle, radians, of a servo position."""
        return self.direction * (count - self.centre_count) * self.units.count_rad


class ServoPlace(NamedTuple):
    """Where a servo is: what it turns, its line and its ID there."""

    kind: Literal["joint", "wheel"]
    name: str
    network: str
    id: int

    @property
    def title(self) -> str:
        """Its name, for people."""
        return self.name if self.kind == "joint" else f"wheel {self.name}"


def check_lines(servos: Iterable[ServoPlace], lines: Collection[str]) -> None:
    """Raises ValueError for a servo on a line that there is not, a line without servos, and two servos with one ID on
    one line."""
    at: dict[tuple[str, int], ServoPlace] = {}
    for one in servos:
        if one.network not in lines:
            raise ValueError(f"{one.kind} {one.name}: there is no network {one.network!r}")
        if (other := at.setdefault((one.network, one.id), one)) is not one:
            says = f"{other.name!r} has the ID {one.id} on network {one.network!r}, too"
            raise ValueError(f"{one.kind} {one.name}: {says}")
    if idle := sorted(set(lines) - {line for line, _ in at}):
        raise ValueError(f"network {idle[0]}: no joint is on it")


def check_groups(joints: Iterable[JointRow], groups: Mapping[str, Group]) -> None:
    """`groups`: by joint, its group. Raises ValueError for a group without joints, and for one that is spread over
    several lines: its commands and states are those of one line."""
    lines: dict[Group, set[str]] = {group: set() for group in GROUPS}
    for row in joints:
        if (group := groups.get(row.name)) is not None:
            lines[group].add(row.network)
    for group, found in lines.items():
        if not found:
            raise ValueError(f"no joint is in the group {group!r}")
        if len(found) > 1:
            raise ValueError(f"the joints of the group {group!r} are on several networks: {', '.join(sorted(found))}")
