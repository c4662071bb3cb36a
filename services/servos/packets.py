"""Status packets of Protocol 1.0, found in whatever comes over the wire. Pure.

`FF FF ID LENGTH ERROR data CHECKSUM`, LENGTH = bytes of data + 2, CHECKSUM = inverted sum from ID on (ROBOTIS AX-12
manual). Instructions are written by the SDK; what it is given to read has been through here.
"""

from __future__ import annotations

from typing import NamedTuple

from services.servos.table import REFUSALS

HEADER = b"\xff\xff"
BROADCAST = 254
READ = 2


class Status(NamedTuple):
    packet: bytes
    error: int
    data: bytes


def find_status(stream: bytes, number: int, length: int) -> Status | None:
    """The answer of servo `number` to what asks for `length` bytes; None while there is none.

    A packet counts only when everything in it is right: its number, its length, its checksum. An answer without data
    counts where data were asked for only when it says that it refuses. All else is passed over, byte by byte, so that
    a broken packet cannot hide a good one.
    """
    at = stream.find(HEADER)
    while at >= 0:
        for size in (length, 0):
            packet = stream[at : at + size + 6]
            if len(packet) < size + 6 or packet[2] != number or packet[3] != size + 2 or packet[4] & 0x80:
                continue
            if ~sum(packet[2:-1]) & 0xFF != packet[-1]:
                continue
            if size == length or packet[4] & REFUSALS:
                return Status(packet, packet[4], packet[5:-1])
        at = stream.find(HEADER, at + 1)
    return None


def asked(instruction: bytes) -> tuple[int, int] | None:
    """Of an instruction packet: who is asked, and for how many bytes; None when nobody is to answer."""
    number = instruction[2]
    if number == BROADCAST:
        return None
    return number, instruction[6] if instruction[4] == READ else 0
