"""What waits to be sent to one viewer: no queue, but the newest of each kind."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from typing import Any, Literal

from services.cockpit.scene import encoded

Kind = Literal["stopped", "hello", "tick", "played", "state", "map", "picture"]
ORDER: tuple[Kind, ...] = ("stopped", "hello", "tick", "played", "state", "map", "picture")
"""What is sent first."""
REPLIES = 64
"""Answers that may wait; they are as many as a viewer asks at once."""

LINES = 500
"""Lines of the log that may wait; beyond it the oldest are left out."""


class Outbox:
    """Sends what is put in, the newest of each kind. `run` never returns."""

    def __init__(self) -> None:
        self._newest: dict[Kind, str | bytes] = {}
        self._replies: deque[str] = deque(maxlen=REPLIES)
        self._lines: deque[dict[str, Any]] = deque(maxlen=LINES)
        self._changed = asyncio.Event()

    def put(self, kind: Kind, message: str | bytes) -> None:
        """Send it when the viewer can take it, unless a newer one of its kind has come by then."""
        self._newest[kind] = message
        self._changed.set()

    def reply(self, message: str) -> None:
        """Send an answer."""
        self._replies.append(message)
        self._changed.set()

    def log(self, lines: Iterable[dict[str, Any]]) -> None:
        """Send lines of the log, all of them together."""
        self._lines.extend(lines)
        self._changed.set()

    async def run(self, send: Callable[[str | bytes], Awaitable[None]]) -> None:
        """Send for ever; `send` returns when the next can be taken. Raises what it raises."""
        while True:
            while (message := self._next()) is not None:
                await send(message)
            self._changed.clear()
            await self._changed.wait()

    def _next(self) -> str | bytes | None:
        if "stopped" in self._newest:
            return self._newest.pop("stopped")
        if self._replies:
            return self._replies.popleft()
        for kind in ORDER:
            if kind in self._newest:
                return self._newest.pop(kind)
        if self._lines:
            lines = list(self._lines)
            self._lines.clear()
            return encoded({"kind": "log", "lines": lines})
        return None
