"""The clients that ask for tasks and are still there, by their liveliness tokens.

A token drops when its process ends, however that ends, and when the mesh has not heard from the process for the lease.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress

from cocoro.keys import asker_key, service_of
from cocoro.node import Node

ARRIVAL_S = 0.5
"""Longest wait for the token of an asker, which may come a moment after his request."""


class Askers:
    """The askers whose tokens live. Calls `gone` with the name of each whose token drops."""

    def __init__(self, node: Node, gone: Callable[[str], None]) -> None:
        self._gone = gone
        self._here: set[str] = set()
        self._news = asyncio.Event()
        node.keep(node.bus.watch_alive(asker_key(node.robot_name), self._on_token))

    def _on_token(self, key: str, alive: bool) -> None:
        asker = service_of(key)
        if alive:
            self._here.add(asker)
            self._news.set()
        elif asker in self._here:
            self._here.discard(asker)
            self._gone(asker)

    async def present(self, asker: str, patience_s: float = ARRIVAL_S) -> bool:
        """Whether an asker is there; waits so long for one that is not known now."""
        with suppress(TimeoutError):
            async with asyncio.timeout(patience_s):
                while asker not in self._here:
                    self._news.clear()
                    await self._news.wait()
        return asker in self._here
