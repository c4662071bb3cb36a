"""The one seam to the mesh. Two implementations, neither special: `zenoh` (processes) and `local` (one
process, virtual time). One conformance suite runs against both.

A bus moves bytes between keys and calls back in the event loop's thread; meaning (types, ages, sequence
numbers) is the node's. `<robot>/*/health`: in a key expression `*` stands for one chunk and `**` for any number.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from enum import Enum
from typing import NamedTuple, Protocol

Payload = bytes | memoryview
OnSample = Callable[[str, Payload], None]
"""Gets the key and the payload, in the loop's thread. The payload stays valid for as long as it is referenced."""
OnAlive = Callable[[str, bool], None]
"""Gets the key of a liveliness token and whether it lives. Called at once for tokens that live already."""
Server = Callable[[str, Payload], Awaitable[bytes]]
"""Answers a request. Raising cocoro.errors.CocoroError answers with an error whose text the caller gets."""


class Qos(Enum):
    """Quality of service of a key."""

    FRAME = "frame"
    """Large, newest wins, shared memory, lowest priority: it never delays a command."""
    STATE = "state"
    """Small, newest wins."""
    COMMAND = "command"
    """Small, newest wins, sent at once at real-time priority; expires."""
    EVENT = "event"
    """Reliable and ordered; nothing is dropped silently."""


class Heard(NamedTuple):
    """A sample, for who listens to everything."""

    key: str
    payload: Payload
    heard_ns: int
    """When it came in: by `cocoro.boottime` between processes, by the loop's time within one."""


OnLot = Callable[[list[Heard]], None]
"""Gets samples in the loop's thread, in the order in which they came."""


class Reply(NamedTuple):
    key: str
    ok: bool
    payload: bytes
    """The answer, or UTF-8 text of the error."""


class Handle(Protocol):
    """Something declared on the bus; `close` takes it back (twice is once)."""

    def close(self) -> None: ...


class RawPublisher(Handle, Protocol):
    def put(self, payload: Payload) -> None:
        """Send; never blocks the loop noticeably, never raises for want of subscribers."""

    @property
    def trouble(self) -> str:
        """Why samples cost more than they should, in words; empty when all is well."""


class Subscription(Handle, Protocol):
    @property
    def skipped(self) -> int:
        """Samples that newer ones overwrote before the loop got to them."""


class Bus(Protocol):
    @property
    def where(self) -> str:
        """In words, for errors: 'tcp/127.0.0.1:7447', 'in this process'."""

    def new_incarnation(self) -> int:
        """A number that no other start of a publisher on this mesh has; deterministic on the local bus."""

    def publisher(self, key: str, qos: Qos) -> RawPublisher: ...

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> Subscription:
        """`depth` bounds what may wait for the loop, per key; beyond it the oldest is dropped and counted.
        Order per key is kept. Qos.EVENT: nothing is dropped."""

    def listen(self, keyexpr: str, handler: OnLot, every_s: float) -> Handle:
        """All that travels there; nothing is dropped. It comes in lots, one in `every_s` at most, since waking the loop
        for each of a thousand samples a second would cost more than all that is done with them. Closing it gives
        the handler what has come until then."""

    def serve(self, key: str, server: Server) -> Handle: ...

    async def call(self, keyexpr: str, payload: bytes, timeout_s: float) -> list[Reply]:
        """Ask everyone who serves a matching key. Returns the answers when all have answered or the time is over;
        raises cocoro.errors.CallTimeoutError when by then none has. An empty list means that nobody serves it."""

    def declare_alive(self, key: str) -> Handle:
        """A liveliness token: it vanishes with this process, however it ends."""

    def watch_alive(self, keyexpr: str, handler: OnAlive) -> Handle: ...

    async def alive(self, keyexpr: str, timeout_s: float = 1.0) -> list[str]:
        """The keys of the matching tokens that live now."""

    async def close(self) -> None:
        """Take everything back and leave the mesh; afterwards nothing calls back."""
