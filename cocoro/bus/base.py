"""The interface to the mesh. Two implementations: `zenoh` (between processes) and `local` (one process, virtual time).
One conformance suite (tests/test_bus_*.py) runs against both.

A bus moves bytes between keys and calls back in the event loop's turn: alone, between two other callbacks of the loop.
Handlers of samples may run in another thread than the loop's while the loop waits (`cocoro.lending`). Types, ages and
sequence numbers are the node's. For keys and key expressions see `cocoro.keys`.
"""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable
from enum import Enum
from typing import NamedTuple, Protocol

from cocoro.errors import CocoroError

log = logging.getLogger(__name__)

Payload = bytes | memoryview
OnSample = Callable[[str, Payload], None]
"""Called with key and payload, in the loop's turn. The payload stays valid for as long as it is referenced."""
OnAlive = Callable[[str, bool], None]
"""Called with the key of a liveliness token and whether it lives; first for every token that lives already."""
Server = Callable[[str, Payload], Awaitable[bytes]]
"""Answers a request. Raises cocoro.errors.CocoroError to answer with an error; the caller gets its text."""


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


class Received(NamedTuple):
    """One sample, as a listener to all keys gets it."""

    key: str
    payload: Payload
    received_ns: int
    """Time of arrival: `cocoro.clock.steady_ns` on zenoh, the loop's time on the local bus."""


OnBatch = Callable[[list[Received]], None]
"""Called with samples in order of arrival, in the loop's thread."""


class Reply(NamedTuple):
    key: str
    ok: bool
    payload: bytes
    """The encoded answer, or the error's text in UTF-8."""


class Handle(Protocol):
    """Something declared on the bus. `close` undeclares it; closing twice is allowed."""

    def close(self) -> None: ...


class RawPublisher(Handle, Protocol):
    def put(self, payload: Payload) -> None:
        """Sends. Does not block the loop noticeably, and does not raise when there is no subscriber."""

    @property
    def trouble(self) -> str:
        """The reason for which samples cost more than they should; '' when they do not."""


class Subscription(Handle, Protocol):
    @property
    def skipped(self) -> int:
        """Samples that newer ones replaced before the loop read them."""


class Bus(Protocol):
    @property
    def where(self) -> str:
        """The mesh's place, for error messages: 'tcp/127.0.0.1:7447', 'in this process'."""

    def new_incarnation(self) -> int:
        """A number that no other publisher on this mesh has, for one start of a publisher. The local bus counts."""

    def publisher(self, key: str, qos: Qos) -> RawPublisher: ...

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> Subscription:
        """Call `handler` in the loop's turn with each sample, in order per key. At most `depth` samples per key wait
        for the loop; beyond it the oldest is dropped and counted, but none with Qos.EVENT."""

    def listen(self, keyexpr: str, handler: OnBatch, every_s: float) -> Handle:
        """Receives all samples, in batches at most every `every_s`; nothing is dropped. Batches, because waking the
        loop for each of a thousand samples a second costs more than handling them. Closing delivers what waits."""

    def serve(self, key: str, server: Server) -> Handle: ...

    async def call(self, keyexpr: str, payload: bytes, timeout_s: float, qos: Qos = Qos.COMMAND) -> list[Reply]:
        """Sends a request to every server with a matching key. Returns the answers when all have answered or the time
        is over; an empty list when there is no server. Raises CallTimeoutError when none has answered in time."""

    def declare_alive(self, key: str) -> Handle:
        """Declares a liveliness token: it vanishes with this process, however that ends."""

    def watch_alive(self, keyexpr: str, handler: OnAlive) -> Handle: ...

    async def alive(self, keyexpr: str, timeout_s: float = 1.0) -> list[str]:
        """The keys of the matching tokens that live now."""

    async def close(self) -> None:
        """Undeclares everything and leaves the mesh; no callback is called afterwards."""


async def answer(server: Server, key: str, payload: Payload) -> Reply:
    """Calls a server. A CocoroError's text goes to the caller; any other exception is a bug, logged here and named to
    the caller as an internal error."""
    try:
        return Reply(key, True, bytes(await server(key, payload)))
    except CocoroError as error:
        return Reply(key, False, str(error).encode())
    except Exception as error:
        log.exception("the server of %s failed", key)
        return Reply(key, False, f"internal error: {type(error).__name__}: {error}".encode())
