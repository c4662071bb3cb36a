"""The emergency stop."""

from __future__ import annotations

import msgspec

from cocoro.messages.common import LatchState, Message


class EstopRequest(msgspec.Struct, kw_only=True):
    """Latches or releases the emergency stop. Every service that moves something, and the executive, answer it."""

    latched: bool
    by: str = ""


class EstopReply(msgspec.Struct, kw_only=True):
    service: str
    latch: LatchState
    text: str = ""


class Latch(Message):
    """State of the emergency stop by the executive. A restarted hardware service stays still until it receives this."""

    state: LatchState
    by: str = ""
