"""When messages of a topic are rejected: whose fault it is, in words, and whether the topic can still be read."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from math import inf
from typing import Any

from cocoro.topics import Topic

UNREADABLE_S, UNREADABLE_PERIODS, UNREADABLE_COUNT = 0.6, 6, 3
"""A topic of a fixed rate is unreadable when for so long, and for so many of its periods, nothing was taken, and at
least so many messages were rejected. A stream that began anew is followed (see `cocoro.source`) sooner than that."""
TOLD_S = 10.0
"""For so long after the last rejected message the reader's health tells of it."""


class Trouble:
    """Kept by an `Inbox`: `grows` with each rejected message, `ends` with the next good one."""

    def __init__(self, topic: Topic[Any]) -> None:
        self.unreadable = False
        self.since_s: float | None = None
        """When the first message was rejected since the last good one; None when none was."""
        self.changed: Callable[[], None] | None = None
        """Called when the topic becomes unreadable, and when it can be read again."""
        self._publisher = topic.publisher
        self._limit_s = max(UNREADABLE_S, UNREADABLE_PERIODS / topic.rate_hz) if topic.rate_hz else inf
        self._key = ""
        self._newest_s = -inf
        self._run = 0

    def grows(self, key: str) -> None:
        """A message on a key was rejected."""
        self._newest_s = now_s = _now_s()
        self._key = key
        if self.since_s is None:
            self.since_s, self._run = now_s, 0
        self._run += 1
        if not self.unreadable and self._run >= UNREADABLE_COUNT and now_s - self.since_s >= self._limit_s:
            self._set(True)

    def ends(self) -> None:
        """A message was taken."""
        self.since_s = None
        if self.unreadable:
            self._set(False)

    def _set(self, unreadable: bool) -> None:
        self.unreadable = unreadable
        if self.changed is not None:
            self.changed()

    def told(self, rejected: int, why: str) -> str:
        """Which key and publisher is at fault, and what with; '' when nothing was rejected of late."""
        if _now_s() - self._newest_s > TOLD_S:
            return ""
        _, _, name = self._key.partition("/")
        publisher = name.partition("/")[0] if self._publisher == "*" else self._publisher
        return f"{name} of {publisher}: {rejected} rejected: {why}"


def _now_s() -> float:
    """Real time that nobody sets, or virtual: the loop's own. The robot's clock may be what is not understood."""
    try:
        return asyncio.get_running_loop().time()
    except RuntimeError:  # a reader without a loop
        return time.monotonic()
