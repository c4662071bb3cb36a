"""A profile's `[mesh]` table."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta


class Mesh(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The place where a robot's processes meet. Without endpoints it is the run directory.
    The fields are those of `cocoro.bus.endpoints.ZenohConfig`."""

    mode: Literal["peer", "client", "router"] = "peer"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    lease_s: Annotated[float, Meta(gt=0)] = 4.0
    patience_s: Annotated[float, Meta(gt=0)] = 1.0
    options: dict[str, Any] = {}
