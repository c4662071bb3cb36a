"""Who owns the sockets of this machine, by the kernel (sock_diag(7)): an address says only what its maker chose."""

from __future__ import annotations

import socket
import struct
import sys
from contextlib import suppress

_SOCK_DIAG = 4
_BY_FAMILY, _DUMP_REQUEST = 20, 0x301
_SHOW_NAME_AND_USER = 0x01 | 0x40
_NAME, _USER = 0, 7
_HEADER, _ATTRIBUTE = struct.Struct("=IHHII"), struct.Struct("=HH")
_REQUEST = struct.Struct("=BBHIIIII")
_ABOUT_BYTES = 16
"""What stands between an entry's header and its attributes."""
_PATIENCE_S = 0.1
_MOST_BYTES = 1 << 18


def owners(prefix: bytes) -> dict[bytes, int]:
    """User ids by address, of the Unix sockets whose address begins so; empty where the kernel does not tell."""
    found: dict[bytes, int] = {}
    with suppress(OSError, struct.error), socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _SOCK_DIAG) as kernel:
        kernel.settimeout(_PATIENCE_S)
        question = _REQUEST.pack(socket.AF_UNIX, 0, 0, 0xFFFFFFFF, 0, _SHOW_NAME_AND_USER, 0, 0)
        kernel.send(_HEADER.pack(_HEADER.size + len(question), _BY_FAMILY, _DUMP_REQUEST, 1, 0) + question)
        while _take(kernel.recv(_MOST_BYTES), prefix, found):
            pass
    return found


def _take(data: bytes, prefix: bytes, found: dict[bytes, int]) -> bool:
    """Read one packet of entries; False when there is nothing more to come."""
    at = 0
    while at < len(data):
        length, kind, *_ = _HEADER.unpack_from(data, at)
        if kind != _BY_FAMILY or length < _HEADER.size:
            return False
        attributes = {}
        inside = at + _HEADER.size + _ABOUT_BYTES
        while inside < at + length:
            size, name = _ATTRIBUTE.unpack_from(data, inside)
            attributes[name] = data[inside + _ATTRIBUTE.size : inside + size]
            inside += max((size + 3) & ~3, _ATTRIBUTE.size)
        if attributes.get(_NAME, b"").startswith(prefix) and len(attributes.get(_USER, b"")) == 4:
            found[attributes[_NAME]] = int.from_bytes(attributes[_USER], sys.byteorder)
        at += (length + 3) & ~3
    return True
