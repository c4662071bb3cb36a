"""Whose process is at the other end of a loopback connection: the kernel knows the user.

The kernel is asked by sock_diag, which looks one connection up in some 20 us; where a sandbox forbids that, by the
tables in /proc/net, which take milliseconds. A socket that its process has closed is reported with user 0 and without
an inode: that is nobody, and in no case root.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import struct
from contextlib import suppress
from pathlib import Path

Address = tuple[str, int]
"""An IP address and a port."""

NETLINK_SOCK_DIAG = 4
SOCK_DIAG_BY_FAMILY = 20
NLM_F_REQUEST = 1
NLMSG_ERROR = 2
ANY_STATE = 0xFFFFFFFF
_HEAD = struct.Struct("=IHHII")
_ASKED = struct.Struct("=BBBBI")
_FOUND_AT = 4 + 48 + 12
"""Offset of user and inode in `struct inet_diag_msg`: family and state, the addresses, timer and queues."""
TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))


def plain(address: str) -> str:
    """An IP address in its usual form: without a zone, and an IPv4 address that came as IPv6 as IPv4."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    mapped = getattr(found, "ipv4_mapped", None)
    return str(mapped or found)


def is_loopback(address: str) -> bool:
    try:
        return ipaddress.ip_address(plain(address)).is_loopback
    except ValueError:
        return False


class Peers:
    """Tells the user of a connection's other end. `close` it."""

    def __init__(self) -> None:
        self._netlink: socket.socket | None = None
        with suppress(OSError):
            self._netlink = socket.socket(
                socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC, NETLINK_SOCK_DIAG
            )
        self._serial = 0

    @property
    def quick(self) -> bool:
        """Whether the kernel answers by sock_diag."""
        return self._netlink is not None

    def user(self, peer: Address, here: Address) -> int | None:
        """The user whose process holds the socket `peer`, which is connected to `here` on this machine; None when no
        process does, or when nobody can say."""
        if self._netlink is not None:
            try:
                return self._asked(self._netlink, peer, here)
            except OSError:
                self.close()
        return _listed(peer, here)

    def _asked(self, netlink: socket.socket, peer: Address, here: Address) -> int | None:
        """Raises OSError where the kernel does not answer such questions."""
        with suppress(BlockingIOError):
            while netlink.recv(8192):  # an answer that came too late for its question
                pass
        self._serial = (self._serial + 1) & 0xFFFFFFFF
        there, ours = plain(peer[0]), plain(here[0])
        family = socket.AF_INET6 if ":" in there else socket.AF_INET
        addresses = b"".join(socket.inet_pton(family, one).ljust(16, b"\0") for one in (there, ours))
        ports = struct.pack("!HH", peer[1], here[1])
        asked = _ASKED.pack(family, socket.IPPROTO_TCP, 0, 0, ANY_STATE) + ports + addresses
        asked += struct.pack("=I", 0) + b"\xff" * 8  # any interface, any cookie
        head = _HEAD.pack(_HEAD.size + len(asked), SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST, self._serial, 0)
        netlink.send(head + asked)
        answer = netlink.recv(8192)
        _, kind, _, serial, _ = _HEAD.unpack_from(answer)
        if serial != self._serial:
            return None
        if kind == NLMSG_ERROR:
            (error,) = struct.unpack_from("=i", answer, _HEAD.size)
            if -error in (2, 22):  # ENOENT: there is no such connection any more
                return None
            raise OSError(-error, os.strerror(-error))
        user, inode = struct.unpack_from("=II", answer, _HEAD.size + _FOUND_AT)
        return int(user) if inode else None

    def close(self) -> None:
        netlink, self._netlink = self._netlink, None
        if netlink is not None:
            netlink.close()


def _listed(peer: Address, here: Address) -> int | None:
    """The user by the tables of /proc/net."""
    wanted = {(_hex(peer[0], wide), _hex(here[0], wide)) for wide in (False, True)}
    for table in TABLES:
        try:
            rows = table.read_text().splitlines()[1:]
        except OSError:
            continue
        for row in rows:
            fields = row.split()
            (mine, my_port), (other, other_port) = fields[1].split(":"), fields[2].split(":")
            if int(my_port, 16) == peer[1] and int(other_port, 16) == here[1] and (mine, other) in wanted:
                return int(fields[7]) if fields[9] != "0" else None
    return None


def _hex(address: str, wide: bool) -> str:
    """An address as the tables write it: words of 32 bits in the order of this machine. `wide`: of the table of IPv6,
    which has IPv4 addresses of sockets that are both."""
    found = ipaddress.ip_address(plain(address))
    if found.version == 4 and wide:
        found = ipaddress.ip_address(f"::ffff:{found}")
    words = struct.unpack(f"={len(found.packed) // 4}I", found.packed)
    return "".join(f"{word:08X}" for word in words)
