"""Subscribes to any keys of a robot's mesh, including keys that this project does not know."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from contextlib import suppress
from difflib import get_close_matches
from typing import NamedTuple

from apps.cli.completions import topics
from apps.cli.link import MeshLink
from cocoro.bus.base import Payload, Qos
from cocoro.errors import ConfigError
from cocoro.installed import topic_named

DEPTH = 64
"""Payloads of one key that may wait for this process's loop."""
WAITING = 2000
"""Payloads that may wait for a slow terminal."""


class ReceivedPayload(NamedTuple):
    key: str
    payload: Payload
    at_s: float
    """Time of arrival on this machine's monotonic clock, s."""


def keyexpr_of(text: str, robot: str) -> str:
    """The key expression of a key that an operator wrote with or without the robot's name.

    Raises ConfigError for an invalid key.
    """
    chunks = text.split("/")
    if not text or any(not chunk or ("*" in chunk and chunk not in ("*", "**")) for chunk in chunks):
        raise ConfigError(f"{text!r} is not a key; write it as base/state, */health or ** (`cocoro topics` lists them)")
    return text if chunks[0] == robot else f"{robot}/{text}"


def takes_frames(text: str) -> bool:
    """Whether frames may be among the messages of this key."""
    topic = topic_named(text)
    return topic is None or topic.qos is Qos.FRAME


def nothing_on(keyexpr: str) -> str:
    """Text for a key without messages: which known key is like it, or where keys are listed."""
    key = keyexpr.partition("/")[2]
    close = get_close_matches(key, {*topics("")} - {key}, 1) if topic_named(key) is None and "*" not in key else []
    advice = f"did you mean {close[0]}?" if close else "`cocoro topics` lists topics, `cocoro top` the live ones"
    return f"nothing on {keyexpr} yet; {advice}"


class KeyListener:
    """Collects what arrives on a key expression; payloads that are not taken in time are dropped and counted."""

    def __init__(self, link: MeshLink, keyexpr: str) -> None:
        self.keyexpr = keyexpr
        self._waiting: deque[ReceivedPayload] = deque()
        self._arrived = asyncio.Event()
        self._overflowed = 0
        self._subscription = link.bus.subscribe(keyexpr, Qos.STATE, self._take, depth=DEPTH)

    def _take(self, key: str, payload: Payload) -> None:
        if len(self._waiting) >= WAITING:
            self._waiting.popleft()
            self._overflowed += 1
        self._waiting.append(ReceivedPayload(key, payload, time.monotonic()))
        self._arrived.set()

    @property
    def dropped(self) -> int:
        return self._subscription.skipped + self._overflowed

    def take(self) -> list[ReceivedPayload]:
        """Removes and returns all waiting payloads."""
        waiting = list(self._waiting)
        self._waiting.clear()
        self._arrived.clear()
        return waiting

    async def wait(self, end: asyncio.Event, timeout_s: float | None = None) -> bool:
        """Waits for a payload; returns False when `end` is set or the time has passed before."""
        arrived, ended = asyncio.ensure_future(self._arrived.wait()), asyncio.ensure_future(end.wait())
        await asyncio.wait((arrived, ended), timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
        for task in (arrived, ended):
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        return bool(self._waiting) and not end.is_set()

    def close(self) -> None:
        self._subscription.close()
