"""Recorded payloads as today's message types."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any, NamedTuple

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from cocoro.capture.former import todays_name, todays_payload
from cocoro.capture.mcap import DamageError
from cocoro.installed import topic_named
from cocoro.messages import Frame, Message

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
    if topic is None or (schema is not None and todays_name(schema) != topic.type.__name__):
        return None
    kind: type[Message] = topic.type
    decode = msgspec.msgpack.Decoder(kind).decode
    return lambda payload: decode(todays_payload(kind.__name__, payload))


class LossyFrame(Message):
    """In place of a Frame on the same key, where a recorder was told to save room; stamp, sequence and incarnation are
    the frame's."""

    width: Annotated[int, Meta(ge=1, le=4096)]
    height: Annotated[int, Meta(ge=1, le=4096)]
    colour_jpeg: bytes
    depth: memoryview
    """As in Frame."""


def expand(lossy: LossyFrame) -> Frame:
    """A frame that looks like the one that was recorded. Raises DamageError when the picture is none."""
    pixels = cv2.imdecode(np.frombuffer(lossy.colour_jpeg, dtype=np.uint8), cv2.IMREAD_COLOR)
    if pixels is None or pixels.shape[:2] != (lossy.height, lossy.width):
        raise DamageError("a frame's picture is damaged")
    return Frame(
        stamp_ns=lossy.stamp_ns,
        seq=lossy.seq,
        incarnation=lossy.incarnation,
        width=lossy.width,
        height=lossy.height,
        colour=memoryview(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB).tobytes()),
        depth=lossy.depth,
    )


MSGPACK, JSON, OTHER = "msgpack", "json", "application/octet-stream"
MADE_HERE = "recorder"
"""The channel metadata `publisher` of what was never published: the recorder's own notes."""


class MessageHead(msgspec.Struct, gc=False):
    """The fields that every message has, decoded alone; a payload of others may lack any of them."""

    stamp_ns: int = 0
    seq: int = 0
    incarnation: int = 0


class Alive(Message):
    """A liveliness token came or went, as the recorder saw it: a service of the robot, by its key."""

    alive: bool


ENCODING = "jsonschema"


class TypeSchema(NamedTuple):
    name: str
    encoding: str
    data: bytes


@cache
def schema_of(kind: type[msgspec.Struct]) -> TypeSchema:
    """The schema of a message's type: an object at its root, binary fields as `contentEncoding: binary`."""
    whole = msgspec.json.schema(kind)
    parts = dict(whole.get("$defs", {}))
    root = parts.pop(kind.__name__, whole)
    found = {"$schema": "https://json-schema.org/draft/2020-12/schema", **root}
    if parts:
        found["$defs"] = parts
    return TypeSchema(kind.__name__, ENCODING, json.dumps(_binary(found), separators=(",", ":")).encode())


def _binary(node: Any) -> Any:
    """MessagePack carries bytes as they are, not as text in base 64."""
    if isinstance(node, dict):
        return {
            name: "binary" if (name, value) == ("contentEncoding", "base64") else _binary(value)
            for name, value in node.items()
        }
    return [_binary(item) for item in node] if isinstance(node, list) else node
