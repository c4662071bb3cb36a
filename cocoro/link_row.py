"""A row of the description's `[[link]]`: where a link is in its parent's frame."""

from __future__ import annotations

import msgspec
from msgspec import UNSET, UnsetType

from cocoro.units import Vec3

DENAVIT_HARTENBERG = ("theta_deg", "d_m", "alpha_deg", "r_m")
ORIGIN = ("xyz_m", "rpy_deg")
_FORMS = f"a link needs {', '.join(DENAVIT_HARTENBERG)}, or {' and '.join(ORIGIN)}"


class LinkRow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A link's place in its parent's frame, in one of two forms, then the turn of `joint` about the link's z axis.

    Raises ValueError (from msgspec ValidationError) naming the link when neither form is whole, or both are begun. What
    is not given is not in the row as data, either: a row is the same data, whatever forms are added.
    """

    name: str
    parent: str
    theta_deg: float | UnsetType = UNSET
    d_m: float | UnsetType = UNSET
    alpha_deg: float | UnsetType = UNSET
    r_m: float | UnsetType = UNSET
    """By Denavit and Hartenberg: Rz(theta), then d along z, then r along the new x, then Rx(alpha)."""
    joint: str | None = None
    offset_deg: float = 0.0
    xyz_m: Vec3 | UnsetType = UNSET
    rpy_deg: Vec3 | UnsetType = UNSET
    """As the origin of a URDF's joint: the place of the link's frame, and its roll, pitch and yaw about the parent's x,
    y and z axes, in this order."""

    def __post_init__(self) -> None:
        given = [form for form in (DENAVIT_HARTENBERG, ORIGIN) if any(map(self._has, form))]
        if len(given) != 1:
            begun = [field for form in given for field in form if self._has(field)]
            what = f"{', '.join(begun)} do not go together" if given else "its place is missing"
            raise ValueError(f"link {self.name}: {what}; {_FORMS}")
        if missing := [field for field in given[0] if not self._has(field)]:
            raise ValueError(f"link {self.name}: {' and '.join(missing)} missing; {_FORMS}")

    def _has(self, field: str) -> bool:
        return getattr(self, field) is not UNSET
