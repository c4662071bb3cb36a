"""The door of the cockpit: which connections are taken, before anything of them is read, and for how long they stay.

The event loop behind it also answers STOP. So the door bounds what the loop can be made to do: it takes few
connections at once, refuses cheaply, stops taking any for a moment when even refusing becomes too much, hands on little
data at a time, and ends connections that say nothing, take nothing or send too much. A newcomer for whom there is no
room takes the place of a connection that has never asked anything, so 500 silent sockets keep nobody out.
"""

from __future__ import annotations

import asyncio
import ipaddress
import os
import socket
import ssl
from collections.abc import Callable
from contextlib import suppress

from services.cockpit.access_connection import Connection
from services.cockpit.access_limits import Audit, Budgets, DoorLimits
from services.cockpit.access_peer import Address, Peers, is_loopback, plain

Protocols = Callable[[], asyncio.Protocol]


AT_ONCE = 8
"""Connections that are looked at before the loop does something else."""
SHUT_S = 0.05
SWEEP_S = 0.5
HANDSHAKE_S = 5.0
BACKLOG = 128
TCP_THIN_LINEAR_TIMEOUTS = 16
"""Of Linux (linux/tcp.h): what few packets carry is sent again after equal times, and not after ever longer ones. On a
network that loses packets, the picture and what waits behind it come that much sooner."""
OTHERS, GONE = "another user's process", "its process has gone"
FOREIGN = (
    b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Type: text/plain; charset=utf-8\r\n\r\n"
    b"This cockpit is another user's of this machine. `cocoro stop` is for everybody.\n"
)


class Door:
    """Listens on a socket, and takes connections for a server's protocol. Has what asyncio expects of a server."""

    def __init__(
        self,
        listener: socket.socket,
        protocols: Protocols,
        *,
        context: ssl.SSLContext | None = None,
        local_only: bool = True,
        limits: DoorLimits | None = None,
        audit: Audit | None = None,
        peers: Peers | None = None,
    ) -> None:
        """`local_only`: processes of other users are turned away; otherwise they must log in, as from elsewhere."""
        self.loop = asyncio.get_running_loop()
        self.sockets = (listener,)
        self.connections: dict[Address, Connection] = {}
        self.swept_s = 0.0
        """Time by sweeps: it stands while this process does, which is no client's fault."""
        self.audit = audit or Audit()
        self._listener, self._protocols, self.context, self._local_only = listener, protocols, context, local_only
        self.limits = limits or DoorLimits()
        self._peers = peers or Peers()
        clock = self.loop.time
        self._takes = Budgets(self.limits.takes, clock)
        self._takes_all = Budgets(self.limits.takes_all, clock)
        self._refusals = Budgets(self.limits.refusals, clock)
        self._shaking: set[asyncio.Task[None]] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._open = False
        listener.setblocking(False)

    # --- what asyncio and uvicorn call -------------------------------------------------------------

    def start(self) -> None:
        self._listener.listen(BACKLOG)
        self._open = True
        self.take_newcomers()
        self._timer = self.loop.call_later(SWEEP_S, self._sweep)

    def close(self) -> None:
        self._open = False
        self.loop.remove_reader(self._listener.fileno())
        if self._timer is not None:
            self._timer.cancel()
        for task in self._shaking:
            task.cancel()
        self.audit.tell()
        self._peers.close()

    async def wait_closed(self) -> None:
        """All has happened in `close`."""

    # --- newcomers --------------------------------------------------------------------------------

    def take_newcomers(self) -> None:
        if self._open:
            self.loop.add_reader(self._listener.fileno(), self._on_newcomers)

    def hold_newcomers(self) -> None:
        """Leaves newcomers to the kernel, until `take_newcomers`."""
        self.loop.remove_reader(self._listener.fileno())

    def _shut(self, for_s: float) -> None:
        self.hold_newcomers()
        self.loop.call_later(for_s, self.take_newcomers)

    def _on_newcomers(self) -> None:
        for _ in range(AT_ONCE):
            try:
                taken, address = self._listener.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError as error:  # no descriptors or no memory left
                self.audit.refused("everybody", f"no connection can be taken: {error.strerror}")
                self._shut(1.0)
                return
            if not self._admit(taken, (plain(str(address[0])), int(address[1]))) and not self._refusals.take(""):
                self.audit.refused("everybody", "a flood of connections: the door was shut for a moment")
                self._shut(SHUT_S)
                return

    def _admit(self, taken: socket.socket, address: Address) -> bool:
        """Takes a connection, or closes it; returns which."""
        key, user, why = _who(address[0]), None, ""
        if is_loopback(address[0]):
            found = self._peers.user(address, taken.getsockname()[:2])
            key = "nobody" if found is None else f"user {found}"
            if found in (0, os.geteuid()):
                user = found
            elif self._local_only:
                why = GONE if found is None else OTHERS
        if not why:
            why = self._no_room(key)
        if why:
            self.audit.refused(key, f"connection: {why}")
            with taken, suppress(OSError):
                taken.setblocking(False)
                if why == OTHERS and self.context is None:
                    taken.send(FOREIGN)
                    taken.shutdown(socket.SHUT_WR)
            return False
        taken.setblocking(False)
        with suppress(OSError):
            taken.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            taken.setsockopt(socket.IPPROTO_TCP, TCP_THIN_LINEAR_TIMEOUTS, 1)
        connection = Connection(self, address, key, user, self._protocols())
        self.connections[address] = connection
        task = self.loop.create_task(self._connect(taken, connection))
        self._shaking.add(task)
        task.add_done_callback(lambda done: self._connected(done, taken, connection))
        return True

    def _no_room(self, key: str) -> str:
        """Why a newcomer cannot be taken; '' when there is room, or room was made."""
        if not self._takes.take(key):
            return "too many in a second"
        if not self._takes_all.take(""):
            return "too many in a second, of all"
        if self.context is not None and len(self._shaking) >= self.limits.handshakes:
            return "too many handshakes"
        mine = [each for each in self.connections.values() if each.key == key]
        if len(mine) >= self.limits.each and not self._make_room(mine):
            return "too many open"
        if len(self.connections) >= self.limits.connections and not self._make_room([*self.connections.values()]):
            return "too many open, of all"
        return ""

    def _make_room(self, among: list[Connection]) -> bool:
        """Ends the connection that is missed least: one that has asked nothing, else one that waits for its next
        request; none that is being answered."""
        free = [each for each in among if not each.busy]
        if not free:
            return False
        least = min(free, key=lambda each: (bool(each.requests), each.since_s))
        self.audit.refused(least.key, "connection: ended to make room for another")
        self.connections.pop(least.address, None)
        least.told = True
        least.abort()
        return True

    async def _connect(self, taken: socket.socket, connection: Connection) -> None:
        seconds = HANDSHAKE_S if self.context is not None else None
        await self.loop.connect_accepted_socket(
            lambda: connection, taken, ssl=self.context, ssl_handshake_timeout=seconds
        )

    def _connected(self, task: asyncio.Task[None], taken: socket.socket, connection: Connection) -> None:
        self._shaking.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is None and not task.cancelled():
            return
        self.left(connection)
        with suppress(OSError):
            taken.close()
        if isinstance(error, OSError):  # of which ssl.SSLError is one
            what = getattr(error, "reason", None) or type(error).__name__
            self.audit.refused(connection.key, "connection: TLS handshake failed", str(what))
        elif error is not None:
            raise error

    # --- those that were taken --------------------------------------------------------------------

    def find(self, address: object) -> Connection | None:
        """The connection of a client, by `scope["client"]`."""
        match address:
            case [str() as host, int() as port]:
                return self.connections.get((plain(host), port))
        return None

    def left(self, connection: Connection) -> None:
        if self.connections.get(connection.address) is connection:
            del self.connections[connection.address]
        if connection.received and not connection.requests and not connection.told:
            self.audit.refused(connection.key, "connection: no request of HTTP")

    def _sweep(self) -> None:
        self.swept_s += SWEEP_S
        for connection in list(self.connections.values()):
            if why := connection.fault(self.swept_s, self.limits):
                connection.told = True
                if why != "idle":
                    self.audit.refused(connection.key, f"connection: it {why}")
                connection.abort()
        self.audit.tell()
        self._timer = self.loop.call_later(SWEEP_S, self._sweep)


def _who(address: str) -> str:
    """Whom a connection counts for by its address: who has an address of IPv6 has all of its network."""
    return str(ipaddress.ip_network(f"{address}/64", strict=False)) if ":" in address else address
