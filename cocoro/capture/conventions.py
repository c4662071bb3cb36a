"""What a capture is beyond MCAP."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping

import msgspec
from mcap.records import (
    Channel,
)

from cocoro.errors import CocoroError, ConfigError


class CaptureError(CocoroError):
    """A capture cannot be read, or written; the text names the file."""


class NotAFileError(CaptureError, ConfigError):
    """Something else than a file was named: a pipe, a device."""


PROFILE = "cocoro"
"""In the MCAP header: the conventions of docs/captures.md hold."""
MAKER = "cocoro"
"""The header's library begins with this in files that were written here."""


class KeyTally(msgspec.Struct):
    """Counts of one channel of a file."""

    messages: int = 0
    size_bytes: int = 0
    """Size of the payloads."""
    first_ns: int = 0
    last_ns: int = 0
    """Log times."""
    longest_gap_ns: int = 0
    """Between two messages' log times."""
    longest_gap_from_ns: int = 0

    def add(self, log_ns: int, size_bytes: int) -> None:
        if not self.messages:
            self.first_ns = log_ns
        elif log_ns - self.last_ns > self.longest_gap_ns:
            self.longest_gap_ns, self.longest_gap_from_ns = log_ns - self.last_ns, self.last_ns
        self.last_ns = log_ns
        self.messages += 1
        self.size_bytes += size_bytes


TALLY = "tally"
"""The metadata record that a whole file ends with: what it has of each key, and what is missing."""


def tally_names(channels: Mapping[int, Channel]) -> dict[int, str]:
    """The name of each channel in the tally, by its number: its key, or KEY#NUMBER where a key has several."""
    counts = Counter(channel.topic for channel in channels.values())
    return {
        id: channel.topic if counts[channel.topic] == 1 else f"{channel.topic}#{id}" for id, channel in channels.items()
    }


CHECKSUM = "crc32"
"""The metadata entry with the checksum of the others."""


def checksum(entries: Mapping[str, str]) -> str:
    """Over names and values, sorted by name, each followed by a zero byte."""
    crc = 0
    for name in sorted(entries):
        if name != CHECKSUM:
            crc = zlib.crc32(f"{name}\0{entries[name]}\0".encode(), crc)
    return f"{crc:08x}"
