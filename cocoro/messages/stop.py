"""The emergency stop."""

from __future__ import annotations

import msgspec

from cocoro.messages.common import LatchState, Message


class EstopRequest(msgspec.Struct, kw_only=True):
    """Latch or release the emergency stop; every hardware service and the executive answer it."""

    latched: bool
    by: str = ""


class EstopReply(msgspec.Struct, kw_only=True):
    service: str
    latch: LatchState
    text: str = ""


class Latch(Message):
    """The executive's word on the emergency stop; a restarted hardware service stays still until it hears it."""

    state: LatchState
    by: str = ""
