"""Messages of the recorder."""

from __future__ import annotations

from typing import Literal

import msgspec

from cocoro.messages.common import Count, FiniteNonNegative, Message


class DisturbedFile(msgspec.Struct, kw_only=True):
    """A capture that was moved or removed while it was being written."""

    file: str
    """Path under which it was recorded."""
    became: Literal["moved", "removed"]
    """A move to another disk counts as removed."""
    now: str = ""
    """Path at which it was found; '' when unknown."""
    lost: Count = 0
    """Number of messages in a removed file."""


class Recording(Message):
    """Progress of a recorder."""

    file: str = ""
    """The MCAP file that is being written; '' when it is no longer on disk."""
    messages: Count = 0
    """Messages written since the recorder's start to all its files, except removed ones."""
    size_bytes: Count = 0
    """Size of these files on disk."""
    raw_bytes: Count = 0
    """Size of these messages before compression."""
    waiting_bytes: Count = 0
    """Size of the messages that are received and not yet written."""
    dropped: dict[str, Count] = {}
    """By key: messages that were received and dropped, because the buffer was full."""
    lost: dict[str, Count] = {}
    """By key: messages that were sent and not received, from gaps in the sequence."""
    disturbed: tuple[DisturbedFile, ...] = ()
    """The most recent files that were moved or removed while they were being written."""
    removed: Count = 0
    """Number of messages in all removed files."""
    longest_sync_ms: FiniteNonNegative = 0.0
    """Longest time that the disk needed for a sync."""
    fault: str = ""
    """Why recording has stopped; empty while it works."""
    left_out: dict[str, Count] = {}
    """By key: large messages that were left out by intention, while nothing happened. They are no loss."""
    occasion: str = ""
    """What happens and is recorded whole, in words; empty while nothing does."""
    task_id: str = ""
    """The newest task that the file contains."""
    rate_bytes_per_s: FiniteNonNegative = 0.0
    """Growth on disk over the last minute."""
    free_bytes: Count = 0
    """Free room on the disk, without what the recorder leaves free."""
    kept_bytes: Count = 0
    """Size of this robot's captures, without pinned ones, when the file began."""
    keep_bytes: Count | None = None
    """Limit of that; None without one."""
    ended: bool = False
    """True when the recorder was stopped and its file is complete."""
