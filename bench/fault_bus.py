"""A bus that can make services fail: die, hang, fall silent or be late."""

from __future__ import annotations

import asyncio
from typing import Literal

from cocoro.bus.base import Handle, OnAlive, OnBatch, OnSample, Payload, Qos, Reply, Server, Subscription
from cocoro.bus.local import LocalBus
from deploy.processes import hardware

Way = Literal["dies", "silent", "hangs", "late"]
"""dies: sends and receives nothing, and its token is gone. silent: sends nothing. hangs: sends and receives nothing,
but its token stays. late: its messages arrive `LATE_S` late, in order."""
LATE_S = 1.0


class _Publisher:
    def __init__(self, bus: FaultyBus, key: str, qos: Qos) -> None:
        self._bus = bus
        self._owner = bus.owner(key)
        self._raw = bus.whole.publisher(key, qos)

    def put(self, payload: Payload) -> None:
        way = self._bus.way(self._owner)
        if way is None:
            self._raw.put(payload)
        elif way == "late":
            asyncio.get_running_loop().call_later(LATE_S, self._raw.put, bytes(payload))

    @property
    def trouble(self) -> str:
        return self._raw.trouble

    def close(self) -> None:
        self._raw.close()


class FaultyBus:
    """The bus of the service `name`. The simulator's bus is also that of each hardware service."""

    where = "in this process"

    def __init__(self, bus: LocalBus, name: str) -> None:
        self.whole = bus
        self._name = name
        self._ways: dict[str, Way] = {}
        self._tokens: dict[str, Handle] = {}

    def fail(self, service: str, way: Way) -> None:
        """Make a service fail in that way from now on."""
        self._ways[service] = way
        if way == "dies" and service in self._tokens:
            self._tokens[service].close()

    def way(self, service: str) -> Way | None:
        """The way in which a service fails; None when it does not fail."""
        return self._ways.get(service)

    def owner(self, key: str) -> str:
        """The service that publishes, reads or serves a key."""
        service = key.split("/")[1]
        return service if self._name == "sim" and service in hardware() else self._name

    def _deaf(self, owner: str) -> bool:
        return self._ways.get(owner) in ("dies", "hangs")

    # --- cocoro.bus.base.Bus ----------------------------------------------------------------------

    def new_incarnation(self) -> int:
        return self.whole.new_incarnation()

    def publisher(self, key: str, qos: Qos) -> _Publisher:
        return _Publisher(self, key, qos)

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> Subscription:
        owner = self.owner(keyexpr)

        def hear(key: str, payload: Payload) -> None:
            if not self._deaf(owner):
                handler(key, payload)

        return self.whole.subscribe(keyexpr, qos, hear, depth=depth)

    def listen(self, keyexpr: str, handler: OnBatch, every_s: float) -> Handle:
        return self.whole.listen(keyexpr, handler, every_s)

    def serve(self, key: str, server: Server) -> Handle:
        owner = self.owner(key)

        async def answer(asked: str, payload: Payload) -> bytes:
            if self._deaf(owner):
                await asyncio.get_running_loop().create_future()
            return await server(asked, payload)

        return self.whole.serve(key, answer)

    async def call(self, keyexpr: str, payload: bytes, timeout_s: float, qos: Qos = Qos.COMMAND) -> list[Reply]:
        return await self.whole.call(keyexpr, payload, timeout_s, qos)

    def declare_alive(self, key: str) -> Handle:
        token = self.whole.declare_alive(key)
        self._tokens[key.split("/")[1]] = token
        return token

    def watch_alive(self, keyexpr: str, handler: OnAlive) -> Handle:
        def tell(key: str, alive: bool) -> None:
            if not self._deaf(self._name):
                handler(key, alive)

        return self.whole.watch_alive(keyexpr, tell)

    async def alive(self, keyexpr: str, timeout_s: float = 1.0) -> list[str]:
        return await self.whole.alive(keyexpr, timeout_s)

    async def close(self) -> None:
        await self.whole.close()
