"""The bus of one process: deterministic, no threads, for virtual time and for tests.

A `LocalMesh` is the network; each participant joins it for a bus of its own, so that one can leave, or be killed
(`kill`), and the others see what they would see on a real mesh.
"""

from __future__ import annotations

import asyncio
from collections import defaultdict, deque
from collections.abc import Callable

from cocoro.bus.base import OnAlive, OnSample, Payload, Reply, Server
from cocoro.bus.keys import matches
from cocoro.errors import CallTimeoutError, CocoroError
from cocoro.topics import Qos


class LocalMesh:
    """What the participants share. `transport_s` is the time that a sample takes from put to callback."""

    def __init__(self, transport_s: float = 0.0) -> None:
        self.transport_s = transport_s
        self.subscriptions: list[LocalSubscription] = []
        self.servers: list[_Serving] = []
        self.tokens: dict[str, int] = defaultdict(int)
        self.watchers: list[_Watch] = []
        self._incarnations = 0
        self._matching: dict[str, list[LocalSubscription]] = {}

    def join(self) -> LocalBus:
        return LocalBus(self)

    def new_incarnation(self) -> int:
        self._incarnations += 1
        return self._incarnations

    def publish(self, key: str, payload: Payload) -> None:
        hit = self._matching.get(key)
        if hit is None:
            hit = self._matching[key] = [s for s in self.subscriptions if matches(s.keyexpr, key)]
        for subscription in hit:
            subscription.offer(key, payload)

    def changed(self) -> None:
        """A subscription came or went."""
        self._matching.clear()

    def token(self, key: str, change: int) -> None:
        before = self.tokens[key]
        self.tokens[key] = before + change
        if (before > 0) != (self.tokens[key] > 0):
            for watch in list(self.watchers):
                if matches(watch.keyexpr, key):
                    watch.tell(key, self.tokens[key] > 0)


class _Closable:
    def __init__(self, undo: Callable[[], None]) -> None:
        self._undo: Callable[[], None] | None = undo

    def close(self) -> None:
        undo, self._undo = self._undo, None
        if undo is not None:
            undo()


class LocalSubscription:
    """A ring per key between `put` and the loop, as on the real mesh."""

    def __init__(self, mesh: LocalMesh, keyexpr: str, qos: Qos, handler: OnSample, depth: int) -> None:
        self.keyexpr = keyexpr
        self.skipped = 0
        self._mesh = mesh
        self._handler: OnSample | None = handler
        self._depth = None if qos is Qos.EVENT else depth
        self._waiting: dict[str, deque[Payload]] = {}
        mesh.subscriptions.append(self)
        mesh.changed()

    def offer(self, key: str, payload: Payload) -> None:
        loop = asyncio.get_running_loop()
        if self._mesh.transport_s > 0:
            loop.call_later(self._mesh.transport_s, self._arrive, key, payload)
        else:
            self._arrive(key, payload)

    def _arrive(self, key: str, payload: Payload) -> None:
        ring = self._waiting.get(key)
        if ring is None:
            ring = self._waiting[key] = deque()
        if not ring:
            asyncio.get_running_loop().call_soon(self._drain, key)
        if self._depth is not None and len(ring) >= self._depth:
            ring.popleft()
            self.skipped += 1
        ring.append(payload)

    def _drain(self, key: str) -> None:
        ring = self._waiting[key]
        while ring:
            payload = ring.popleft()
            if self._handler is not None:
                self._handler(key, payload)

    def close(self) -> None:
        self._handler = None
        if self in self._mesh.subscriptions:
            self._mesh.subscriptions.remove(self)
            self._mesh.changed()


class LocalPublisher:
    def __init__(self, mesh: LocalMesh, key: str) -> None:
        self._mesh: LocalMesh | None = mesh
        self._key = key

    def put(self, payload: Payload) -> None:
        if self._mesh is not None:
            self._mesh.publish(self._key, payload)

    def close(self) -> None:
        self._mesh = None


class _Serving:
    def __init__(self, bus: LocalBus, key: str, server: Server) -> None:
        self.bus, self.key, self.server = bus, key, server

    async def answer(self, payload: bytes) -> Reply:
        try:
            return Reply(self.key, True, bytes(await self.server(self.key, payload)))
        except CocoroError as error:
            return Reply(self.key, False, str(error).encode())


class _Watch:
    def __init__(self, keyexpr: str, handler: OnAlive) -> None:
        self.keyexpr = keyexpr
        self._handler: OnAlive | None = handler

    def tell(self, key: str, alive: bool) -> None:
        asyncio.get_running_loop().call_soon(self._call, key, alive)

    def _call(self, key: str, alive: bool) -> None:
        if self._handler is not None:
            self._handler(key, alive)

    def close(self) -> None:
        self._handler = None


class LocalBus:
    """One participant of a `LocalMesh`."""

    where = "in this process"

    def __init__(self, mesh: LocalMesh) -> None:
        self._mesh = mesh
        self._declared: list[_Closable | LocalSubscription | LocalPublisher] = []
        self._answers: set[asyncio.Task[Reply]] = set()

    def new_incarnation(self) -> int:
        return self._mesh.new_incarnation()

    def publisher(self, key: str, qos: Qos) -> LocalPublisher:
        publisher = LocalPublisher(self._mesh, key)
        self._declared.append(publisher)
        return publisher

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> LocalSubscription:
        subscription = LocalSubscription(self._mesh, keyexpr, qos, handler, depth)
        self._declared.append(subscription)
        return subscription

    def serve(self, key: str, server: Server) -> _Closable:
        serving = _Serving(self, key, server)
        self._mesh.servers.append(serving)
        return self._keep(_Closable(lambda: self._mesh.servers.remove(serving)))

    async def call(self, keyexpr: str, payload: bytes, timeout_s: float) -> list[Reply]:
        servers = [s for s in self._mesh.servers if matches(keyexpr, s.key)]
        if not servers:
            return []
        tasks = []
        for serving in servers:
            task = asyncio.create_task(serving.answer(bytes(payload)))
            serving.bus._answers.add(task)
            task.add_done_callback(serving.bus._answers.discard)
            tasks.append(task)
        await asyncio.wait(tasks, timeout=timeout_s)
        replies = [task.result() for task in tasks if task.done() and not task.cancelled()]
        if not replies:
            raise CallTimeoutError(f"{keyexpr}: no answer within {timeout_s:g} s")
        return replies

    def declare_alive(self, key: str) -> _Closable:
        self._mesh.token(key, +1)
        return self._keep(_Closable(lambda: self._mesh.token(key, -1)))

    def watch_alive(self, keyexpr: str, handler: OnAlive) -> _Closable:
        watch = _Watch(keyexpr, handler)
        self._mesh.watchers.append(watch)
        for key, count in self._mesh.tokens.items():
            if count > 0 and matches(keyexpr, key):
                watch.tell(key, True)

        def undo() -> None:
            watch.close()
            self._mesh.watchers.remove(watch)

        return self._keep(_Closable(undo))

    async def alive(self, keyexpr: str, timeout_s: float = 1.0) -> list[str]:
        return [key for key, count in self._mesh.tokens.items() if count > 0 and matches(keyexpr, key)]

    def kill(self) -> None:
        """Leave as a killed process does: at once, with requests unanswered."""
        for declared in reversed(self._declared):
            declared.close()
        self._declared.clear()
        for task in list(self._answers):
            task.cancel()

    async def close(self) -> None:
        self.kill()

    def _keep(self, closable: _Closable) -> _Closable:
        self._declared.append(closable)
        return closable
