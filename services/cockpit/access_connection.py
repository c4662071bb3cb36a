"""A connection that the door has taken: what passes through it is counted, and bounded, before the server sees it."""

from __future__ import annotations

import asyncio
from typing import Any, Protocol, cast

from services.cockpit.access_limits import Bucket, DoorLimits
from services.cockpit.access_peer import Address

PIECE = 4096
"""Bytes that are parsed before the loop does something else."""


class Doorkeeper(Protocol):
    """What a connection knows of the door that has taken it."""

    loop: asyncio.AbstractEventLoop
    limits: DoorLimits
    swept_s: float
    """Time by the door's sweeps: it stands while this process does, which is no client's fault."""

    def left(self, connection: Connection) -> None:
        """A connection has ended."""


class Connection(asyncio.Protocol):
    """A connection that was taken: stands between the transport and the server's protocol, and counts."""

    def __init__(self, door: Doorkeeper, address: Address, key: str, user: int | None, inner: asyncio.Protocol) -> None:
        self.address, self.key, self.user = address, key, user
        self.requests = 0
        """That have begun."""
        self.busy = 0
        """Requests and sockets that are being answered."""
        self.certificate: dict[str, Any] | None = None
        """Of the client, as `ssl.SSLSocket.getpeercert` gives it: verified by its authority."""
        self.received = 0
        """Bytes."""
        self.told = False
        """Whether the log has its end."""
        self._door, self._inner = door, inner
        self._loop = door.loop
        self.since_s = door.swept_s
        """When it was taken, or its last request was answered, by the door's sweeps."""
        self._transport: asyncio.Transport | None = None
        self._stalled_s: float | None = None
        self._overfed_s: float | None = None
        self._bytes = Bucket(door.limits.bytes, self._loop.time())
        self._rest = b""
        self._timer: asyncio.TimerHandle | None = None
        self._held = False
        """Whether the server's protocol has asked for a pause."""

    # --- as the transport sees it -----------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        tls = transport.get_extra_info("ssl_object")
        if tls is not None:
            self.certificate = tls.getpeercert() or None
        self._inner.connection_made(cast(asyncio.Transport, _Facade(self._transport, self)))

    def data_received(self, data: bytes) -> None:
        self.received += len(data)
        self._rest += data
        if self._timer is None:
            self._hand_on()

    def _hand_on(self) -> None:
        """Gives the server's protocol a piece; what is left later, when the loop has done something else and the
        budget allows it."""
        self._timer = None
        if self._rest and not self._held and self._transport is not None and not self._transport.is_closing():
            piece, self._rest = self._rest[:PIECE], self._rest[PIECE:]
            now_s = self._loop.time()
            wait_s = self._bytes.owe(now_s, len(piece))
            if not wait_s:
                self._overfed_s = None
            elif self._overfed_s is None:
                self._overfed_s = self._door.swept_s
            self._inner.data_received(piece)
            if self._rest or wait_s:
                self._timer = self._loop.call_later(wait_s, self._hand_on)
        self._read_or_not()

    def _read_or_not(self) -> None:
        if self._transport is None or self._transport.is_closing():
            return
        if self._held or self._rest or self._timer is not None:
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()

    def eof_received(self) -> bool | None:
        return self._inner.eof_received()

    def pause_writing(self) -> None:
        self._stalled_s = self._door.swept_s
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        self._stalled_s = None
        self._inner.resume_writing()

    def connection_lost(self, error: Exception | None) -> None:
        self._transport, self._rest = None, b""
        if self._timer is not None:
            self._timer.cancel()
        self._door.left(self)
        self._inner.connection_lost(error)

    # --- as the server's protocol and the gate see it -----------------------------------------------

    def set_protocol(self, inner: asyncio.BaseProtocol) -> None:
        self._inner = cast(asyncio.Protocol, inner)

    def get_protocol(self) -> asyncio.BaseProtocol:
        return self._inner

    def hold(self, held: bool) -> None:
        """What the server's protocol calls pausing and resuming to read."""
        self._held = held
        if not held and self._rest and self._timer is None:
            self._timer = self._loop.call_later(0.0, self._hand_on)
        self._read_or_not()

    def begins(self) -> None:
        self.requests += 1
        self.busy += 1

    def ends(self) -> None:
        self.busy -= 1
        self.since_s = self._door.swept_s

    def abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()

    def fault(self, now_s: float, limits: DoorLimits) -> str:
        """Why it must end now; '' when it may stay."""
        if self._stalled_s is not None and now_s - self._stalled_s > limits.stalled_s:
            return "takes nothing"
        if self._overfed_s is not None and now_s - self._overfed_s > limits.overfed_s:
            return "sends too much"
        quiet_s = now_s - self.since_s
        if not self.requests and quiet_s > limits.first_s:
            return "asks nothing"
        return "idle" if not self.busy and quiet_s > limits.idle_s else ""


class _Facade:
    """The transport as the server's protocol sees it: a protocol that it sets comes behind the connection."""

    def __init__(self, transport: asyncio.Transport, connection: Connection) -> None:
        self._transport, self._connection = transport, connection

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        self._connection.set_protocol(protocol)

    def get_protocol(self) -> asyncio.BaseProtocol:
        return self._connection.get_protocol()

    def pause_reading(self) -> None:
        self._connection.hold(True)

    def resume_reading(self) -> None:
        self._connection.hold(False)
