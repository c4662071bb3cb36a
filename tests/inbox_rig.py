"""An inbox, its clock and its messages."""

from __future__ import annotations

from typing import Any

import msgpack

from cocoro import topics
from cocoro.clock import NS, VirtualClock
from cocoro.inbox import Inbox
from cocoro.messages import Message
from cocoro.topics import Topic

KEY = "calliope/key"
FAR = 2**62
"""A number beyond those of all messages and stamps."""


class StillClock(VirtualClock):
    """A clock that stands at a time set by the test."""

    stands = True

    def __init__(self, now_ns: int = 100 * NS) -> None:
        self.at_ns = now_ns

    def now_ns(self) -> int:
        return self.at_ns

    async def sleep_until(self, when_ns: int) -> bool:
        raise AssertionError("nobody waits here")


def inbox_of(topic: Topic[Any], clock: StillClock | None = None) -> tuple[Inbox[Any], list[Message]]:
    inbox = Inbox(topic, KEY, clock or StillClock())
    got: list[Message] = []
    inbox.add(lambda _key, message: got.append(message))
    return inbox, got


def payload(topic: Topic[Any], seq: int = 0, incarnation: int = 1, stamp_ns: int = 100 * NS, **fields: Any) -> bytes:
    goods: dict[str, dict[str, Any]] = {
        topics.BASE_COMMAND.name: {"ahead_mps": 0.1, "turn_radps": 0.1},
        topics.INTENT.name: {"action": {"action": "park"}},
        topics.BASE_STATE.name: {"odometry_m": (0, 0), "odometry_yaw_rad": 0, "speed_mps": 0, "turn_rate_radps": 0},
    }
    packed: bytes = msgpack.packb(
        goods.get(topic.name, {}) | {"seq": seq, "incarnation": incarnation, "stamp_ns": stamp_ns} | fields
    )
    return packed
