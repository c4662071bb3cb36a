"""Conventions of captures beyond MCAP: profile, checksums of metadata, the tally at the file's end, and errors."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping

import msgspec
from mcap.records import Channel

from cocoro.errors import CocoroError, ConfigError


class CaptureError(CocoroError):
    """A capture cannot be read or written. The text names the file."""


class NotAFileError(CaptureError, ConfigError):
    """The path names a pipe or a device."""


PROFILE = "cocoro"
"""MCAP profile of files that follow the conventions of docs/captures.md."""
MAKER = "cocoro"
"""The header's library begins with this in files that this project wrote."""


class KeyTally(msgspec.Struct):
    """Counts of one channel of a file."""

    messages: int = 0
    size_bytes: int = 0
    """Payloads only."""
    first_ns: int = 0
    last_ns: int = 0
    """Log times."""
    longest_gap_ns: int = 0
    """Longest time between the log times of two consecutive messages."""
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
"""Metadata record at the end of a complete file: counts by key, and the number of dropped and lost messages."""
LEFT_OUT = "left_out"
"""Metadata record with the times in which large messages were left out, since nothing happened."""


def tally_names(channels: Mapping[int, Channel]) -> dict[int, str]:
    """Each channel's name in the tally, by channel number: its key, or KEY#NUMBER where a key has several channels."""
    counts = Counter(channel.topic for channel in channels.values())
    return {
        id: channel.topic if counts[channel.topic] == 1 else f"{channel.topic}#{id}" for id, channel in channels.items()
    }


CHECKSUM = "crc32"
"""Metadata entry with the checksum of the record's other entries."""


def checksum(entries: Mapping[str, str]) -> str:
    """CRC-32 of names and values, sorted by name, each followed by a zero byte; 8 hexadecimal digits."""
    crc = 0
    for name in sorted(entries):
        if name != CHECKSUM:
            crc = zlib.crc32(f"{name}\0{entries[name]}\0".encode(), crc)
    return f"{crc:08x}"
