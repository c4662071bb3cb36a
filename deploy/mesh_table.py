"""A profile's `[mesh]` table."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta


class Mesh(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How patient a robot's processes are with each other; the fields are those of `cocoro.bus.endpoints.ZenohConfig`.
    They meet in the run directory of their machine, and by a site's gateways with those of other machines."""

    lease_s: Annotated[float, Meta(gt=0)] = 4.0
    patience_s: Annotated[float, Meta(gt=0)] = 1.0
