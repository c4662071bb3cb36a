"""The bus between processes, on zenoh. Nothing here blocks the event loop, and leaving the mesh never hangs.

Zenoh calls back in its own threads. A callback takes the loop's turn while the loop waits; what arrives while the loop
is busy is queued (`Ring`, `Batches`). In its turn the bytes are copied out of (shared) memory, and only those of
samples that were not replaced by newer ones.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import threading
from collections.abc import Callable
from pathlib import Path
from time import CLOCK_BOOTTIME, clock_gettime_ns
from types import TracebackType
from typing import TypeVar

import zenoh
from zenoh.handlers import Callback

from cocoro.bus.base import OnAlive, OnBatch, OnSample, Qos, Received, Reply, Server, answer
from cocoro.bus.declared import QOS, Declared, SharedPool, ZenohListening, ZenohPublisher, ZenohSubscription, read
from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.foreign import keep_thread_state
from cocoro.bus.queues import Batches, Outbox, Ring
from cocoro.bus.register import Membership, members, new_identity
from cocoro.bus.session import LEAVE_S, Opened, close_session, exit_guard, in_thread, no_mesh, open_session, options
from cocoro.bus.shared import COSTS
from cocoro.errors import CallTimeoutError, MeshError
from cocoro.private import FullError

log = logging.getLogger(__name__)
D = TypeVar("D", bound=Declared)

MEMBER = "@cocoro/member"
"""Each member declares a token below it, named by its zenoh id. No wildcard matches a chunk with '@'."""
LOOK_AGAIN_S = 0.05
"""How often a joining process checks whether the members that it waits for are still registered."""
LATER_S = 1.0
"""Zenoh's time-outs are this much later than ours, since zenoh reports a time-out as an answer."""


class ZenohBus:
    """One process's membership of the mesh. Make it with `await ZenohBus.open(config)`, best in `async with`."""

    def __init__(self, config: ZenohConfig, opened: Opened, membership: Membership | None) -> None:
        self._config = config
        self._session = opened.session
        self._unshared = opened.unshared
        self._membership = membership
        self._loop = asyncio.get_running_loop()
        self._declared: set[Declared] = set()
        self._answers: set[asyncio.Task[None]] = set()
        self._outbox: Outbox | None = None
        self._closed = False
        self._leaving = threading.Lock()
        self._left = False
        exit_guard.add(self._leave)

    @classmethod
    async def open(cls, config: ZenohConfig, *, expect_mesh: bool = False) -> ZenohBus:
        """Joins the mesh. On return the declarations of all members are known, so a first call reaches them all.

        With `expect_mesh` a member must exist already: raises MeshError within `config.patience_s` when none does. It
        then needs no room in the mesh's directory: where that is full it connects to the members, but members that
        join later do not connect to it. Raises ConfigError for a wrong configuration, FullError without room.
        """
        membership, identity = None, new_identity()
        listen, connect = list(config.listen), list(config.connect)
        if config.directory is not None:
            membership = _join(config.directory, config.name, visit=expect_mesh)
            identity, listen, connect = membership.member.identity, membership.listen, membership.connect
        bus: ZenohBus | None = None
        try:
            if expect_mesh and not connect:
                raise no_mesh(config)
            chosen = options(config, identity, listen, connect)
            opened = await in_thread(lambda: open_session(config, chosen), undo=Opened.close)
            bus = cls(config, opened, membership)
            await bus._settle(identity, expect_mesh)
        except BaseException:
            if bus is not None:
                await bus.close()
            elif membership is not None:
                membership.leave()
            raise
        return bus

    async def _settle(self, identity: str, expect_mesh: bool) -> None:
        """Waits for the members' tokens: each declares its own last, and declarations arrive in order."""
        if self._membership is not None:
            awaited = {other.identity: f"{other.name} (process {other.pid})" for other in self._membership.others}
        else:
            awaited = {str(peer): str(peer) for peer in self._session.info.peers_zid()}
            if expect_mesh and not awaited and not self._session.info.routers_zid():
                raise no_mesh(self._config)
        news = asyncio.Event()

        def on_member(key: str, alive: bool) -> None:
            awaited.pop(key.rpartition("/")[2], None)
            news.set()

        deadline_s = self._loop.time() + self._config.patience_s
        with contextlib.closing(self.watch_alive(f"{MEMBER}/*", on_member)):
            while awaited and (left_s := deadline_s - self._loop.time()) > 0:
                news.clear()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(min(left_s, LOOK_AGAIN_S)):
                        await news.wait()
                self._forget_gone(awaited)
        if awaited:
            log.warning("no answer within %g s from %s", self._config.patience_s, ", ".join(awaited.values()))
        if self._config.mode != "client":  # nobody waits for a client
            self.declare_alive(f"{MEMBER}/{identity}")

    def _forget_gone(self, awaited: dict[str, str]) -> None:
        """Stops waiting for members that have left."""
        if awaited and self._config.directory is not None:
            there = {member.identity for member in members(self._config.directory)}
            for identity in awaited.keys() - there:
                del awaited[identity]

    @property
    def where(self) -> str:
        return self._config.where

    def new_incarnation(self) -> int:
        return secrets.randbits(48)

    def publisher(self, key: str, qos: Qos) -> ZenohPublisher:
        if qos is Qos.EVENT and self._outbox is None:
            self._outbox = Outbox(self._config.name)
        outbox = self._outbox if qos is Qos.EVENT else None
        pool, trouble = None, ""
        if qos is Qos.FRAME and not self._unshared:
            pool = SharedPool()
            trouble = f"no shared memory: {pool.trouble}; {COSTS}" if pool.trouble else ""
            if trouble:
                log.warning("%s: %s", key, trouble)
        elif qos is Qos.FRAME:
            trouble = f"no shared memory: {self._unshared}; {COSTS}"
        return self._keep(ZenohPublisher(self._session.declare_publisher(key, **QOS[qos]), outbox, pool, trouble))

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> ZenohSubscription:
        def deliver(key: str, payload: zenoh.ZBytes) -> None:
            data = read(payload)
            if data is None:
                ring.skipped += 1
            else:
                handler(key, data)

        ring = Ring(self._loop, deliver, None if qos is Qos.EVENT else depth, borrows=True)

        only = "" if "*" in keyexpr else keyexpr
        push = ring.push

        def on_sample(sample: zenoh.Sample) -> None:
            keep_thread_state()
            push(only or str(sample.key_expr), sample.payload)

        subscriber = self._session.declare_subscriber(keyexpr, Callback(on_sample, indirect=False))
        return self._keep(ZenohSubscription(subscriber, ring))

    def listen(self, keyexpr: str, handler: OnBatch, every_s: float) -> ZenohListening:
        def deliver(samples: list[tuple[zenoh.Sample, int]]) -> None:
            handler(
                [
                    Received(str(sample.key_expr), data, received_ns)
                    for sample, received_ns in samples
                    if (data := read(sample.payload)) is not None
                ]
            )

        batches = Batches(self._loop, deliver, every_s)
        push = batches.push

        def on_sample(sample: zenoh.Sample) -> None:
            keep_thread_state()
            push((sample, clock_gettime_ns(CLOCK_BOOTTIME)))  # `steady_ns`, without the call

        return self._keep(
            ZenohListening(self._session.declare_subscriber(keyexpr, Callback(on_sample, indirect=False)), batches)
        )

    def serve(self, key: str, server: Server) -> Declared:
        def start(_: str, query: zenoh.Query) -> None:
            task = self._loop.create_task(_answer(server, key, query))
            self._answers.add(task)
            task.add_done_callback(self._answers.discard)

        ring = Ring(self._loop, start, None)

        def on_query(query: zenoh.Query) -> None:
            ring.push(key, query)

        return self._keep(Declared(self._session.declare_queryable(key, Callback(on_query, indirect=False)), ring))

    async def call(self, keyexpr: str, payload: bytes, timeout_s: float, qos: Qos = Qos.COMMAND) -> list[Reply]:
        replies: list[Reply] = []

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                replies.append(Reply(str(reply.ok.key_expr), True, reply.ok.payload.to_bytes()))
            elif reply.err is not None:
                # An error reply has no key; `_answer` puts it into the encoding's schema.
                key = str(reply.err.encoding).partition(";")[2]
                replies.append(Reply(key, False, reply.err.payload.to_bytes()))

        def ask(final: Callable[[], None]) -> None:
            self._session.get(
                keyexpr,
                Callback(on_reply, final, indirect=False),
                payload=payload,
                timeout=timeout_s + LATER_S,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                **QOS[qos],  # the answer has it, too
            )

        try:
            await self._until_final(ask, timeout_s)
        except TimeoutError:
            if not replies:
                raise CallTimeoutError(f"{keyexpr}: no answer within {timeout_s:g} s") from None
        return list(replies)

    def declare_alive(self, key: str) -> Declared:
        return self._keep(Declared(self._session.liveliness().declare_token(key)))

    def watch_alive(self, keyexpr: str, handler: OnAlive) -> Declared:
        ring = Ring(self._loop, handler, None)

        def on_token(sample: zenoh.Sample) -> None:
            ring.push(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        callback = Callback(on_token, indirect=False)
        return self._keep(
            Declared(self._session.liveliness().declare_subscriber(keyexpr, callback, history=True), ring)
        )

    async def alive(self, keyexpr: str, timeout_s: float = 1.0) -> list[str]:
        keys: set[str] = set()

        def on_token(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                keys.add(str(reply.ok.key_expr))

        def ask(final: Callable[[], None]) -> None:
            callback = Callback(on_token, final, indirect=False)
            self._session.liveliness().get(keyexpr, callback, timeout=timeout_s + LATER_S)

        with contextlib.suppress(TimeoutError):
            await self._until_final(ask, timeout_s)
        return sorted(keys)

    async def _until_final(self, ask: Callable[[Callable[[], None]], None], timeout_s: float) -> None:
        """Asks, and waits until zenoh reports that all have answered. Raises TimeoutError when it does not in time."""
        everyone = asyncio.Event()

        def final() -> None:
            with contextlib.suppress(RuntimeError):  # the loop has been closed
                self._loop.call_soon_threadsafe(everyone.set)

        try:
            ask(final)
        except zenoh.ZError as error:
            raise MeshError(f"the mesh at {self.where} has been left: {error}") from error
        async with asyncio.timeout(timeout_s):
            await everyone.wait()

    async def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        for task in list(self._answers):
            task.cancel()
        for declared in self._declared:
            declared.mute()
        try:
            async with asyncio.timeout(LEAVE_S):
                await in_thread(self._leave)
        except TimeoutError:
            log.warning("leaving the mesh at %s took more than %g s; gave up waiting", self.where, LEAVE_S)

    def _leave(self) -> None:
        """Leaves the mesh; blocks. From any thread; only the first call does anything."""
        with self._leaving:
            if self._left:
                return
            if self._outbox is not None:
                self._outbox.close(LEAVE_S / 2)
            if self._membership is not None:
                self._membership.leave()
            close_session(self._session)
            self._left = True
            exit_guard.discard(self._leave)

    def _keep(self, declared: D) -> D:
        self._declared.add(declared)
        declared.on_close = self._declared.discard
        return declared

    async def __aenter__(self) -> ZenohBus:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()


def _join(directory: Path, name: str, visit: bool) -> Membership:
    try:
        return Membership.register(directory, name)
    except FullError as error:
        if not visit:
            raise
        log.warning("%s; until then, services that start from now on are not seen by this command", error)
        return Membership.visit(directory, name)


async def _answer(server: Server, key: str, query: zenoh.Query) -> None:
    with query:  # dropping the query ends the caller's wait
        reply = await answer(server, key, query.payload.to_bytes() if query.payload is not None else b"")
        with contextlib.suppress(zenoh.ZError):  # the caller has gone, or the session has ended
            if reply.ok:
                query.reply(key, reply.payload)
            else:
                query.reply_err(reply.payload, encoding=f"text/plain;{key}")
