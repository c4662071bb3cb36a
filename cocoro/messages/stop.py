"""The emergency stop."""

from __future__ import annotations

import msgspec

from cocoro.messages.common import LatchState, Message


class EstopRequest(msgspec.Struct, kw_only=True):
    """Latches the emergency stop. Every service that moves something, and the executive, answer it."""

    by: str = ""


class ResetRequest(msgspec.Struct, kw_only=True):
    """Releases the emergency stop. The same services answer it."""

    by: str = ""


class EstopReply(msgspec.Struct, kw_only=True):
    """The answer to both: the state of the service's latch after the request."""

    service: str
    latch: LatchState
    text: str = ""


class Latch(Message):
    """State of the emergency stop by the executive. A restarted hardware service stays still until it receives this."""

    state: LatchState
    by: str = ""
