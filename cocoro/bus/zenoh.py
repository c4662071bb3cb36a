"""The bus between processes, on zenoh. Nothing here blocks the event loop, and leaving never hangs.

Zenoh calls back in threads of its own. They only put what arrives into a `Ring`; bytes are copied out of (shared)
memory in the loop's thread, and only those that are still wanted then.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import logging
import secrets
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any, TypeVar, cast

import zenoh
from zenoh.handlers import Callback

from cocoro.bus.answer import answer
from cocoro.bus.base import OnAlive, OnSample, Payload, Reply, Server
from cocoro.bus.endpoints import ZenohConfig, zenoh_options
from cocoro.bus.members import Membership
from cocoro.bus.outbox import Outbox
from cocoro.bus.ring import Ring
from cocoro.errors import CallTimeoutError, ConfigError, MeshError
from cocoro.topics import Qos

log = logging.getLogger(__name__)
T = TypeVar("T")

CLOSE_S = 2.0
"""How long leaving may take before it is given up; the process can end all the same."""
MEMBER = "@cocoro/member"
"""Each member holds a token there with its zenoh id. Wildcards do not match a chunk with '@', so nobody sees it."""

_DROP, _BLOCK = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
_QOS: dict[Qos, dict[str, Any]] = {
    Qos.COMMAND: {"priority": zenoh.Priority.REAL_TIME, "congestion_control": _DROP, "express": True},
    Qos.STATE: {"priority": zenoh.Priority.DATA_HIGH, "congestion_control": _DROP, "express": True},
    Qos.EVENT: {"priority": zenoh.Priority.DATA, "congestion_control": _BLOCK, "express": False},
    Qos.FRAME: {"priority": zenoh.Priority.BACKGROUND, "congestion_control": _DROP, "express": False},
}


class _Declared:
    """Something declared on a session, with the ring that its samples come through, if any."""

    on_close: Callable[[Any], None]

    def __init__(self, declaration: Any, ring: Ring[Any] | None = None) -> None:
        self._declaration = declaration
        self._ring = ring
        self._closed = False

    def mute(self) -> None:
        """Nothing goes through any more, though zenoh still knows of it."""
        self._closed = True
        if self._ring is not None:
            self._ring.close()

    def close(self) -> None:
        if self._closed:
            return
        self.mute()
        self.on_close(self)
        with contextlib.suppress(zenoh.ZError):  # the session has ended
            self._declaration.undeclare()


class ZenohSubscription(_Declared):
    _ring: Ring[zenoh.ZBytes]

    @property
    def skipped(self) -> int:
        return self._ring.skipped


class ZenohPublisher(_Declared):
    def __init__(self, publisher: zenoh.Publisher, outbox: Outbox | None) -> None:
        super().__init__(publisher)
        self._outbox = outbox

    def put(self, payload: Payload) -> None:
        if self._closed:
            return
        data = payload if isinstance(payload, bytes) else bytes(payload)
        if self._outbox is not None:
            self._outbox.put(self._put, data)
        else:
            self._put(data)

    def _put(self, data: bytes) -> None:
        with contextlib.suppress(zenoh.ZError):  # the session has ended
            self._declaration.put(data)


D = TypeVar("D", bound=_Declared)


class ZenohBus:
    """One process's place in the mesh. Make it with `await ZenohBus.open(config)`, best in `async with`."""

    def __init__(self, config: ZenohConfig, session: zenoh.Session, membership: Membership | None) -> None:
        self._config = config
        self._session = session
        self._membership = membership
        self._loop = asyncio.get_running_loop()
        self._declared: set[_Declared] = set()
        self._answers: set[asyncio.Task[None]] = set()
        self._outbox: Outbox | None = None
        self._closed = False
        _open_buses.add(self)

    @classmethod
    async def open(cls, config: ZenohConfig, *, expect_mesh: bool = False) -> ZenohBus:
        """Join the mesh. When this returns, what the members declared is known: a first call reaches them.

        With `expect_mesh` it must be there already: MeshError, within `config.patience_s`, when nobody is.
        ConfigError when the configuration cannot be.
        """
        membership = None
        listen, connect = list(config.listen), list(config.connect)
        if config.directory is not None:
            membership = Membership.register(config.directory, config.name)
            listen, connect = [membership.listen], membership.connect
        identity = membership.member.identity if membership else secrets.token_hex(8).replace("0", "f", 1)
        bus: ZenohBus | None = None
        try:
            if expect_mesh and not connect:
                raise _no_mesh(config)
            options = zenoh_options(config, identity, listen, connect)
            session = await _in_thread(lambda: _open_session(config, options), _close_session)
            bus = cls(config, session, membership)
            await bus._settle(identity, expect_mesh)
        except BaseException:
            if bus is not None:
                await bus.close()
            elif membership is not None:
                membership.leave()
            raise
        return bus

    async def _settle(self, identity: str, expect_mesh: bool) -> None:
        """Wait for the others' tokens: a member declares its own last, and declarations arrive in order."""
        if self._membership is not None:
            awaited = {other.identity for other in self._membership.others}
        else:
            awaited = {str(peer) for peer in self._session.info.peers_zid()}
        found = bool(awaited or self._session.info.routers_zid())
        if expect_mesh and not found:
            raise _no_mesh(self._config)
        complete = asyncio.Event()

        def on_member(key: str, alive: bool) -> None:
            awaited.discard(key.rpartition("/")[2])
            if not awaited:
                complete.set()

        with contextlib.closing(self.watch_alive(f"{MEMBER}/*", on_member)):
            if awaited:
                try:
                    await asyncio.wait_for(complete.wait(), self._config.patience_s)
                except TimeoutError:
                    log.warning(
                        "%d members of the mesh do not answer: %s", len(awaited), self._names(awaited)
                    )
        self.declare_alive(f"{MEMBER}/{identity}")

    def _names(self, identities: set[str]) -> str:
        others = self._membership.others if self._membership else []
        names = {other.identity: f"{other.name} (process {other.pid})" for other in others}
        return ", ".join(sorted(names.get(identity, identity) for identity in identities))

    @property
    def where(self) -> str:
        return self._config.where

    def new_incarnation(self) -> int:
        return secrets.randbits(48)

    def publisher(self, key: str, qos: Qos) -> ZenohPublisher:
        publisher = self._session.declare_publisher(key, **_QOS[qos])
        outbox = None
        if qos is Qos.EVENT:
            outbox = self._outbox = self._outbox or Outbox(self._config.name)
        return self._keep(ZenohPublisher(publisher, outbox))

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> ZenohSubscription:
        def deliver(key: str, payload: zenoh.ZBytes) -> None:
            handler(key, payload.to_bytes())

        ring = Ring(self._loop, deliver, None if qos is Qos.EVENT else depth)

        def on_sample(sample: zenoh.Sample) -> None:
            ring.push(str(sample.key_expr), sample.payload)

        subscriber = self._session.declare_subscriber(keyexpr, Callback(on_sample, indirect=False))
        return self._keep(ZenohSubscription(subscriber, ring))

    def serve(self, key: str, server: Server) -> _Declared:
        def start(_: str, query: zenoh.Query) -> None:
            task = self._loop.create_task(_answer(server, key, query))
            self._answers.add(task)
            task.add_done_callback(self._answers.discard)

        ring = Ring(self._loop, start, None)

        def on_query(query: zenoh.Query) -> None:
            ring.push(key, query)

        queryable = self._session.declare_queryable(key, Callback(on_query, indirect=False))
        return self._keep(_Declared(queryable, ring))

    async def call(self, keyexpr: str, payload: bytes, timeout_s: float) -> list[Reply]:
        replies: list[Reply] = []

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                replies.append(Reply(str(reply.ok.key_expr), True, reply.ok.payload.to_bytes()))
            elif reply.err is not None:
                # An error has no key of its own; `_answer` says it in the encoding's schema.
                key = str(reply.err.encoding).partition(";")[2]
                replies.append(Reply(key, False, reply.err.payload.to_bytes()))

        try:
            await self._until_final(
                timeout_s,
                lambda final: self._session.get(
                    keyexpr,
                    Callback(on_reply, final, indirect=False),
                    payload=payload,
                    # Ours comes first, since zenoh's looks like an error reply.
                    timeout=timeout_s + 1.0,
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    priority=zenoh.Priority.REAL_TIME,
                    congestion_control=_DROP,
                    express=True,
                ),
            )
        except TimeoutError:
            if not replies:
                raise CallTimeoutError(f"{keyexpr}: no answer within {timeout_s:g} s") from None
        return list(replies)

    def declare_alive(self, key: str) -> _Declared:
        return self._keep(_Declared(self._session.liveliness().declare_token(key)))

    def watch_alive(self, keyexpr: str, handler: OnAlive) -> _Declared:
        ring = Ring(self._loop, handler, None)

        def on_sample(sample: zenoh.Sample) -> None:
            ring.push(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        callback = Callback(on_sample, indirect=False)
        watching = self._session.liveliness().declare_subscriber(keyexpr, callback, history=True)
        return self._keep(_Declared(watching, ring))

    async def alive(self, keyexpr: str, timeout_s: float = 1.0) -> list[str]:
        keys: set[str] = set()

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                keys.add(str(reply.ok.key_expr))

        with contextlib.suppress(TimeoutError):
            await self._until_final(
                timeout_s,
                lambda final: self._session.liveliness().get(
                    keyexpr, Callback(on_reply, final, indirect=False), timeout=timeout_s + 1.0
                ),
            )
        return sorted(keys)

    async def _until_final(self, timeout_s: float, ask: Callable[[Callable[[], None]], None]) -> None:
        """Ask, and wait until zenoh says that all have answered. TimeoutError."""
        final = asyncio.Event()

        def on_final() -> None:
            with contextlib.suppress(RuntimeError):  # the loop has been closed
                self._loop.call_soon_threadsafe(final.set)

        ask(on_final)
        await asyncio.wait_for(final.wait(), timeout_s)

    async def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        for task in list(self._answers):
            task.cancel()
        for declared in self._declared:
            declared.mute()
        try:
            await asyncio.wait_for(_in_thread(self._leave), CLOSE_S)
        except TimeoutError:
            log.warning("leaving the mesh at %s took more than %g s", self.where, CLOSE_S)

    def _leave(self) -> None:
        """Blocks; from any thread."""
        _open_buses.discard(self)
        if self._outbox is not None:
            self._outbox.close(CLOSE_S / 2)
        if self._membership is not None:
            self._membership.leave()
        _close_session(self._session)

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


async def _answer(server: Server, key: str, query: zenoh.Query) -> None:
    with query:  # the caller waits until it is dropped
        payload = query.payload.to_bytes() if query.payload is not None else b""
        reply = await answer(server, key, payload)
        with contextlib.suppress(zenoh.ZError):  # the session has ended
            if reply.ok:
                query.reply(key, reply.payload)
            else:
                query.reply_err(reply.payload, encoding=f"text/plain;{key}")


def _no_mesh(config: ZenohConfig) -> MeshError:
    return MeshError(f"no mesh at {config.where}: start one with `cocoro up`")


def _open_session(config: ZenohConfig, options: dict[str, str]) -> zenoh.Session:
    settings = zenoh.Config()
    for path, value in options.items():
        try:
            settings.insert_json5(path, value)
        except zenoh.ZError as error:
            raise ConfigError(f"mesh of {config.name}: {path} = {value}: {error}") from error
    try:
        return zenoh.open(settings)
    except zenoh.ZError as error:
        if config.connect and not config.listen:
            raise _no_mesh(config) from error
        raise MeshError(f"mesh of {config.name}: {error}") from error


def _close_session(session: zenoh.Session) -> None:
    session.close()  # type: ignore[no-untyped-call]


async def _in_thread(work: Callable[[], T], undo: Callable[[T], None] | None = None) -> T:
    """Work that blocks, in a daemon thread, so that it cannot keep the process from ending. When nobody waits
    for it any more as it is done, it is undone."""
    loop = asyncio.get_running_loop()
    future: asyncio.Future[T] = loop.create_future()

    def hand_over(result: T | None, error: BaseException | None) -> None:
        if future.cancelled():
            if error is None and undo is not None:
                undo(cast(T, result))
        elif error is not None:
            future.set_exception(error)
        else:
            future.set_result(cast(T, result))

    def run() -> None:
        result, error = None, None
        try:
            result = work()
        except BaseException as raised:
            error = raised
        with contextlib.suppress(RuntimeError):  # the loop has been closed
            loop.call_soon_threadsafe(hand_over, result, error)

    threading.Thread(target=run, name="mesh", daemon=True).start()
    return await future


_open_buses: set[ZenohBus] = set()


@atexit.register
def _leave_at_exit() -> None:
    """A bus that was not closed: zenoh must not call back into an interpreter that ends."""
    threads = [threading.Thread(target=bus._leave, daemon=True) for bus in _open_buses]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(CLOSE_S)
