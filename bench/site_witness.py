"""Sees what arrives on a host of a site: a member of the robot's private mesh there, past the network and its rules."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

from cocoro.bus.base import Handle, OnBatch, Payload, Received, Reply
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import CocoroError
from deploy.rundir import RunDir

T = TypeVar("T")
EVERY_S = 0.02
PATIENCE_S = 60.0
"""Longest wait for something that comes, on a busy machine."""


class Witness:
    """It keeps what arrives with a mark in it, the keys of all tokens, and the newest sample of each key."""

    def __init__(self, robot: str, run: Path, mark: bytes) -> None:
        self.robot = robot
        self._mark = mark
        self.marked: list[tuple[str, bytes]] = []
        """Samples with the mark: key and payload."""
        self.asked: list[bytes] = []
        """Queries with the mark, while `answer_all` holds."""
        self.tokens: set[str] = set()
        self.newest: dict[str, bytes] = {}
        self.count: dict[str, int] = {}
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="witness", daemon=True)
        self._thread.start()
        self._bus = self._do(ZenohBus.open(RunDir(robot, run).join_as("witness"), expect_mesh=True))
        self._do(self._begin())

    async def _begin(self) -> None:
        self._bus.listen(f"{self.robot}/**", self._on_samples, EVERY_S)
        self._bus.watch_alive(f"{self.robot}/**", self._on_token)

    def _do(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(PATIENCE_S)

    def _on_samples(self, samples: list[Received]) -> None:
        for sample in samples:
            content = bytes(sample.payload)
            self.newest[sample.key] = content
            self.count[sample.key] = self.count.get(sample.key, 0) + 1
            if self._mark in content:
                self.marked.append((sample.key, content[:200]))

    def _on_token(self, key: str, alive: bool) -> None:
        if alive:
            self.tokens.add(key)

    # --- what it does -----------------------------------------------------------------------------

    def ask(self, key: str, payload: bytes, timeout_s: float = 5.0) -> list[Reply]:
        async def ask() -> list[Reply]:
            try:
                return await self._bus.call(key, payload, timeout_s)
            except CocoroError:  # nobody has answered in time
                return []

        return self._do(ask())

    def answer_all(self) -> Handle:
        """Serves all keys of the robot, and keeps what is asked with the mark; until it is closed."""

        async def answer(_key: str, payload: Payload) -> bytes:
            if self._mark in bytes(payload):
                self.asked.append(bytes(payload))
            raise CocoroError("a witness has no answer")

        async def serve() -> Handle:
            return self._bus.serve(f"{self.robot}/**", answer)

        return self._do(serve())

    def listen(self, key: str, handler: OnBatch) -> Handle:
        async def listen() -> Handle:
            return self._bus.listen(key, handler, EVERY_S)

        return self._do(listen())

    def end(self, handle: Handle) -> None:
        async def end() -> None:
            handle.close()

        self._do(end())

    def close(self) -> None:
        self._do(self._bus.close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def __enter__(self) -> Witness:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def until(what: Callable[[], T], patience_s: float = PATIENCE_S) -> T:
    """Waits for a result that is true, and returns it. Raises TimeoutError."""
    deadline_s = time.monotonic() + patience_s
    while not (found := what()):
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"not within {patience_s:g} s")
        time.sleep(0.02)
    return found
