"""Both buses for one test suite: the local bus in virtual time, and the zenoh bus over Unix sockets."""

from __future__ import annotations

import asyncio
import functools
import itertools
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from cocoro.bus.base import Bus, Payload, Received
from cocoro.bus.endpoints import default
from cocoro.bus.local import LocalBus, LocalMesh
from cocoro.bus.zenoh import ZenohBus
from cocoro.vloop import run_virtual

PATIENCE_S = 30.0


class Mesh(Protocol):
    def run(self, scenario: Coroutine[Any, Any, None]) -> None: ...

    async def join(self) -> Bus: ...

    async def drop(self, bus: Bus) -> None:
        """End a participant without closing its declarations."""


class Local:
    def __init__(self) -> None:
        self.mesh = LocalMesh()

    def run(self, scenario: Coroutine[Any, Any, None]) -> None:
        run_virtual(scenario)

    async def join(self) -> Bus:
        return self.mesh.join()

    async def drop(self, bus: Bus) -> None:
        assert isinstance(bus, LocalBus)
        bus.kill()


class Zenoh:
    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir

    def run(self, scenario: Coroutine[Any, Any, None]) -> None:
        asyncio.run(scenario)

    async def join(self) -> Bus:
        return await ZenohBus.open(replace(default("robot", "test", self.run_dir), shared_memory=True))

    async def drop(self, bus: Bus) -> None:
        await bus.close()


Scenario = Callable[..., Coroutine[Any, Any, None]]


def scenario(test: Scenario) -> Callable[..., None]:
    """Run a coroutine as a test, on the event loop of the mesh's kind and with a time limit for failures."""

    @functools.wraps(test)
    def run(mesh: Mesh, **fixtures: Any) -> None:
        mesh.run(asyncio.wait_for(test(mesh, **fixtures), PATIENCE_S))

    return run


@asynccontextmanager
async def joined(mesh: Mesh, count: int) -> AsyncIterator[list[Bus]]:
    buses = [await mesh.join() for _ in range(count)]
    try:
        yield buses
    finally:
        for bus in buses:
            await bus.close()


class Inbox:
    """Collects the samples of a subscription; a test can wait for its contents."""

    def __init__(self) -> None:
        self.samples: list[tuple[str, bytes]] = []
        self._came = asyncio.Event()

    def __call__(self, key: str, payload: Payload) -> None:
        self.samples.append((key, bytes(payload)))
        self._came.set()

    @property
    def payloads(self) -> list[bytes]:
        return [payload for _, payload in self.samples]

    async def until(self, content: Callable[[], bool]) -> None:
        while not content():
            self._came.clear()
            await self._came.wait()

    async def has(self, payload: bytes) -> None:
        await self.until(lambda: payload in self.payloads)


class Listener:
    """Collects batches, and lets a test wait for so many samples."""

    def __init__(self) -> None:
        self.batches: list[list[Received]] = []
        self._came = asyncio.Event()

    def __call__(self, batch: list[Received]) -> None:
        self.batches.append(batch)
        self._came.set()

    @property
    def heard(self) -> list[Received]:
        return [each for batch in self.batches for each in batch]

    async def has(self, count: int) -> None:
        while len(self.heard) < count:
            self._came.clear()
            await self._came.wait()


numbers = itertools.count()


async def known(who: Bus, *by: Bus) -> None:
    """Wait until other buses know all earlier declarations of a bus; declarations arrive in order."""
    key = f"known/{next(numbers)}"
    token = who.declare_alive(key)
    for bus in by:
        await appears(bus, key)
    token.close()


async def appears(bus: Bus, key: str, alive: bool = True) -> None:
    seen = asyncio.Event()

    def changed(_key: str, state: bool) -> None:
        if state == alive:
            seen.set()

    watch = bus.watch_alive(key, changed)
    await seen.wait()
    watch.close()


async def echo(key: str, payload: Payload) -> bytes:
    return key.encode() + b":" + bytes(payload)
