"""Recorded payloads as today's message types."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import msgspec

from cocoro.capture.errors import DamageError
from cocoro.capture.keys import Alive
from cocoro.capture.pictures import LossyFrame, expand
from cocoro.installed import topic_named
from cocoro.messages import Message

Read = Callable[[bytes | memoryview], msgspec.Struct]


class NotReadableError(DamageError):
    """A recorded message cannot be had as today's type."""


@cache
def reader_of(name: str, schema: str | None) -> Read | None:
    """How payloads of a topic (the key without the robot) are read, by the recorded schema's name; None for keys that
    are not in today's table. Lossy frames come as frames."""
    if schema == Alive.__name__:
        return msgspec.msgpack.Decoder(Alive).decode
    if schema == LossyFrame.__name__:
        decoder = msgspec.msgpack.Decoder(LossyFrame)
        return lambda payload: expand(decoder.decode(payload))
    topic = topic_named(name)
    if topic is None or (schema is not None and schema != topic.type.__name__):
        return None
    kind: type[Message] = topic.type
    return msgspec.msgpack.Decoder(kind).decode
