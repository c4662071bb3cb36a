"""Publishing on one topic, and the encoding of messages."""

from __future__ import annotations

from typing import Generic, TypeVar

import msgspec
import numpy as np

from cocoro.bus.base import Bus, Payload
from cocoro.clock import NS, Clock
from cocoro.errors import CocoroError
from cocoro.health import Rate
from cocoro.messages import Message, TopicHealth
from cocoro.topics import Topic

M = TypeVar("M", bound=Message)


class Publisher(Generic[M]):
    """Publishes on one topic, and fills in stamp, sequence number and incarnation."""

    def __init__(self, topic: Topic[M], key: str, bus: Bus, clock: Clock) -> None:
        self.topic = topic
        self.key = key
        self.rate = Rate()
        self.newest_stamp_ns: int | None = None
        self._type = topic.type
        self._raw = bus.publisher(key, topic.qos)
        self.incarnation = bus.new_incarnation()
        self._clock = clock
        self._newest: bytes | None = None
        """Encoded; kept of a topic whose newest message can be asked for."""
        self._keeps = topic.askable

    def put(self, message: M, stamp_ns: int | None = None) -> M:
        """Publishes the message and returns it, completed in place. `stamp_ns` defaults to the message's own stamp, or
        to now when that is 0. Raises TypeError when the topic carries another type."""
        if not isinstance(message, self._type):
            raise TypeError(f"{self.topic.name} carries {self.topic.type.__name__}, not {type(message).__name__}")
        if stamp_ns is not None:
            message.stamp_ns = stamp_ns
        elif message.stamp_ns == 0:
            message.stamp_ns = self._clock.now_ns()
        message.seq = self.rate.count
        message.incarnation = self.incarnation
        self.rate.count += 1
        self.newest_stamp_ns = message.stamp_ns
        payload = _ENCODER.encode(message)
        if self._keeps:
            self._newest = payload
        self._raw.put(payload)
        return message

    def relay(self, message: M) -> None:
        """Publishes a message of another publisher as it is, with that one's stamp and numbers."""
        self.rate.count += 1
        self.newest_stamp_ns = message.stamp_ns
        self._raw.put(_ENCODER.encode(message))

    async def serve_newest(self, _key: str, _question: Payload) -> bytes:
        """Answers with the newest message. Raises CocoroError before the first."""
        if self._newest is None:
            raise CocoroError(f"{self.key}: nothing was published yet")
        return self._newest

    def close(self) -> None:
        self._raw.close()

    @property
    def trouble(self) -> str:
        """The reason for which its messages cost more than they should; '' when they do not."""
        return f"{self.topic.name}: {self._raw.trouble}" if self._raw.trouble else ""

    def health(self, now_ns: int) -> TopicHealth:
        age_s = None if self.newest_stamp_ns is None else (now_ns - self.newest_stamp_ns) / NS
        return TopicHealth(
            key=self.key, direction="out", count=self.rate.count, rate_hz=self.rate.take(now_ns), age_s=age_s
        )


def encode(message: Message) -> bytes:
    """A message in MessagePack, as it is sent."""
    return _ENCODER.encode(message)


def _numpy_scalar(value: object) -> object:
    """Converts NumPy scalars to Python's. Raises TypeError for anything else."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} cannot be sent")


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_numpy_scalar)
