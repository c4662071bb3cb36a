"""How a recorder is getting on."""

from __future__ import annotations

from typing import Literal

import msgspec

from cocoro.messages.common import Count, FiniteNonNegative, Message


class DisturbedFile(msgspec.Struct, kw_only=True):
    """Somebody moved or removed a file while it was being recorded."""

    file: str
    """The name that it was recorded under."""
    became: Literal["moved", "removed"]
    """A move to another disk is a copy and a removal."""
    now: str = ""
    """Where it was when that was noticed; '' when that is not known."""
    lost: Count = 0
    """Messages that were in it, when it was removed."""


class Recording(Message):
    """How a recorder is getting on."""

    file: str = ""
    """The MCAP file that is being written; '' when it is not on the disk any more."""
    messages: Count = 0
    """Written since the recorder's start, over all its files, but for those that somebody removed meanwhile."""
    size_bytes: Count = 0
    """The same, as it takes room on the disk."""
    raw_bytes: Count = 0
    """The same, before compression."""
    waiting_bytes: Count = 0
    """Received, not yet written."""
    dropped: dict[str, Count] = {}
    """By key: received, but there was no room to keep them until the disk took them."""
    lost: dict[str, Count] = {}
    """By key: gaps in the sequence, so sent and never received."""
    disturbed: tuple[DisturbedFile, ...] = ()
    """The newest of those that somebody moved or removed while they were being recorded."""
    removed: Count = 0
    """Messages that were in the removed ones, all of them together."""
    longest_sync_ms: FiniteNonNegative = 0.0
    """That the disk took to make sure of what it was given."""
    fault: str = ""
    """Why nothing is recorded any more."""
    ended: bool = False
    """The recorder has been told to end, and what it wrote is whole."""
