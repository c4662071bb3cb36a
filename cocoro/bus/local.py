"""The bus within one process: deterministic, no threads, for virtual time and for tests.

A `LocalMesh` is the network. Each participant joins it and gets its own bus, so one can leave or be killed (`kill`)
and the others see what they would see on a real mesh.
"""

from __future__ import annotations

import asyncio
from collections import defaultdict, deque
from typing import TypeVar

from cocoro.bus.base import Handle, OnAlive, OnBatch, OnSample, Payload, Qos, Received, Reply, Server, answer
from cocoro.clock import NS
from cocoro.errors import CallTimeoutError
from cocoro.keys import matches

D = TypeVar("D", bound=Handle)


class LocalMesh:
    """The state shared by all participants. `transport_s` is the time from put to callback of a sample."""

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

    def publish(self, key: str, payload: bytes) -> None:
        hit = self._matching.get(key)
        if hit is None:
            hit = self._matching[key] = [s for s in self.subscriptions if matches(s.keyexpr, key)]
        if self.transport_s > 0:
            asyncio.get_running_loop().call_later(self.transport_s, _offer, hit, key, payload)
        else:
            _offer(hit, key, payload)

    def changed(self) -> None:
        """Call it when a subscription was added or removed."""
        self._matching.clear()

    def token(self, key: str, change: int) -> None:
        before = self.tokens[key]
        self.tokens[key] = before + change
        if (before > 0) != (self.tokens[key] > 0):
            for watch in list(self.watchers):
                if matches(watch.keyexpr, key):
                    watch.report(key, self.tokens[key] > 0)


class LocalSubscription:
    """A ring per key between `put` and the handler, as on the real mesh."""

    def __init__(self, mesh: LocalMesh, keyexpr: str, qos: Qos, handler: OnSample, depth: int) -> None:
        self.keyexpr = keyexpr
        self.skipped = 0
        self._mesh = mesh
        self._handler: OnSample | None = handler
        self._depth = None if qos is Qos.EVENT else depth
        self._waiting: dict[str, deque[tuple[str, bytes]]] = {}
        mesh.subscriptions.append(self)
        mesh.changed()

    def arrive(self, key: str, payload: bytes) -> bool:
        """A sample is there. Returns whether none waited, so that `drain` must be called."""
        place = key if self._depth is not None else ""
        ring = self._waiting.get(place)
        if ring is None:
            self._waiting[place] = deque(((key, payload),), maxlen=self._depth)
            return True
        if len(ring) == self._depth:
            self.skipped += 1
        ring.append((key, payload))
        return False

    def drain(self, key: str) -> None:
        """Hand over what waits with a sample of this key."""
        self._drain(key if self._depth is not None else "")

    def _drain(self, place: str) -> None:
        for key, payload in self._waiting.pop(place, ()):
            if self._handler is None:
                return
            try:
                self._handler(key, payload)
            except Exception as error:
                asyncio.get_running_loop().call_exception_handler(
                    {"message": f"the reader of {key} failed", "exception": error}
                )

    def close(self) -> None:
        self._handler = None
        if self in self._mesh.subscriptions:
            self._mesh.subscriptions.remove(self)
            self._mesh.changed()


def _offer(subscriptions: list[LocalSubscription], key: str, payload: bytes) -> None:
    """A sample arrives at all of its subscriptions, which hand it over in the loop's next turn, one after the other."""
    woken = [subscription for subscription in subscriptions if subscription.arrive(key, payload)]
    if woken:
        asyncio.get_running_loop().call_soon(_drain, woken, key)


def _drain(subscriptions: list[LocalSubscription], key: str) -> None:
    for subscription in subscriptions:
        subscription.drain(key)


class LocalListening(LocalSubscription):
    """A listener; waking a virtual loop costs nothing, so each sample is a batch by itself."""

    def __init__(self, mesh: LocalMesh, keyexpr: str, handler: OnBatch) -> None:
        loop = asyncio.get_running_loop()

        def receive(key: str, payload: Payload) -> None:
            handler([Received(key, payload, round(loop.time() * NS))])

        super().__init__(mesh, keyexpr, Qos.EVENT, receive, depth=1)

    def close(self) -> None:
        for place in list(self._waiting):
            self._drain(place)
        super().close()


class LocalPublisher:
    def __init__(self, mesh: LocalMesh, key: str) -> None:
        self._mesh: LocalMesh | None = mesh
        self._key = key

    @property
    def trouble(self) -> str:
        return ""

    def put(self, payload: Payload) -> None:
        if self._mesh is not None:
            self._mesh.publish(self._key, bytes(payload))

    def close(self) -> None:
        self._mesh = None


class _Serving:
    def __init__(self, bus: LocalBus, key: str, server: Server) -> None:
        self.bus, self.key, self.server = bus, key, server

    def close(self) -> None:
        if self in self.bus.mesh.servers:
            self.bus.mesh.servers.remove(self)


class _Token:
    def __init__(self, mesh: LocalMesh, key: str) -> None:
        self._mesh: LocalMesh | None = mesh
        self._key = key
        mesh.token(key, +1)

    def close(self) -> None:
        mesh, self._mesh = self._mesh, None
        if mesh is not None:
            mesh.token(self._key, -1)


class _Watch:
    def __init__(self, mesh: LocalMesh, keyexpr: str, handler: OnAlive) -> None:
        self.keyexpr = keyexpr
        self._mesh = mesh
        self._handler: OnAlive | None = handler
        mesh.watchers.append(self)
        for key, count in mesh.tokens.items():
            if count > 0 and matches(keyexpr, key):
                self.report(key, True)

    def report(self, key: str, alive: bool) -> None:
        asyncio.get_running_loop().call_soon(self._call, key, alive)

    def _call(self, key: str, alive: bool) -> None:
        if self._handler is not None:
            self._handler(key, alive)

    def close(self) -> None:
        self._handler = None
        if self in self._mesh.watchers:
            self._mesh.watchers.remove(self)


class LocalBus:
    """One participant of a `LocalMesh`."""

    where = "in this process"

    def __init__(self, mesh: LocalMesh) -> None:
        self.mesh = mesh
        self._declared: list[Handle] = []
        self._answers: set[asyncio.Task[Reply]] = set()

    def new_incarnation(self) -> int:
        return self.mesh.new_incarnation()

    def publisher(self, key: str, qos: Qos) -> LocalPublisher:
        return self._keep(LocalPublisher(self.mesh, key))

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> LocalSubscription:
        return self._keep(LocalSubscription(self.mesh, keyexpr, qos, handler, depth))

    def listen(self, keyexpr: str, handler: OnBatch, every_s: float) -> Handle:
        return self._keep(LocalListening(self.mesh, keyexpr, handler))

    def serve(self, key: str, server: Server) -> Handle:
        serving = _Serving(self, key, server)
        self.mesh.servers.append(serving)
        return self._keep(serving)

    async def call(self, keyexpr: str, payload: bytes, timeout_s: float, qos: Qos = Qos.COMMAND) -> list[Reply]:
        tasks = [s.bus.answer(s, payload) for s in self.mesh.servers if matches(keyexpr, s.key)]
        if not tasks:
            return []
        _, unfinished = await asyncio.wait(tasks, timeout=timeout_s)
        replies = [task.result() for task in tasks if task.done() and not task.cancelled()]
        if unfinished and not replies:
            raise CallTimeoutError(f"{keyexpr}: no answer within {timeout_s:g} s")
        return replies

    def answer(self, serving: _Serving, payload: bytes) -> asyncio.Task[Reply]:
        """Answers a call as this participant. Closing this bus cancels the task; the caller's end does not."""
        task = asyncio.create_task(answer(serving.server, serving.key, bytes(payload)))
        self._answers.add(task)
        task.add_done_callback(self._answers.discard)
        return task

    def declare_alive(self, key: str) -> Handle:
        return self._keep(_Token(self.mesh, key))

    def watch_alive(self, keyexpr: str, handler: OnAlive) -> Handle:
        return self._keep(_Watch(self.mesh, keyexpr, handler))

    async def alive(self, keyexpr: str, timeout_s: float = 1.0) -> list[str]:
        return sorted(key for key, count in self.mesh.tokens.items() if count > 0 and matches(keyexpr, key))

    def kill(self) -> None:
        """Leaves as a killed process does: at once, with requests unanswered."""
        for declared in reversed(self._declared):
            declared.close()
        self._declared.clear()
        for task in list(self._answers):
            task.cancel()

    async def close(self) -> None:
        self.kill()

    def _keep(self, declared: D) -> D:
        self._declared.append(declared)
        return declared
