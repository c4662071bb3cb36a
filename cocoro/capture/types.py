"""The message types of a capture: how recorded payloads are read as today's types, and their JSON schemas.

Rules, which msgspec applies to each message:

- A field that today's type does not have is ignored.
- A field that the recorded message lacks takes today's default. Without a default the message can be read only as a
  map.
- A field whose type or limits have changed is read where the recorded value fits today's.

`cocoro.capture.former` has the rules for types whose shape has changed otherwise.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta

from cocoro.capture.former import todays_name, todays_payload
from cocoro.capture.mcap import DamageError
from cocoro.installed import topic_named
from cocoro.messages import Frame, Message


class NotReadableError(DamageError):
    """A recorded message does not fit today's type."""


MADE_HERE = "recorder"
"""Channel metadata `publisher` of messages that the recorder made itself and nobody published."""


class MessageHead(msgspec.Struct, gc=False):
    """The fields that every message of this project has, decoded alone. Payloads of other programs may lack them."""

    stamp_ns: int = 0
    seq: int = 0
    incarnation: int = 0


class Alive(Message):
    """The recorder's note that a liveliness token appeared or disappeared; the key names the service."""

    alive: bool


class LossyFrame(Message):
    """A frame with its colour as JPEG, recorded in place of a Frame on the same key to save room. Stamp, sequence
    number and incarnation are the frame's."""

    width: Annotated[int, Meta(ge=1, le=4096)]
    height: Annotated[int, Meta(ge=1, le=4096)]
    colour_jpeg: bytes
    depth: memoryview
    """As in Frame."""


def expand(lossy: LossyFrame) -> Frame:
    """Returns a frame that looks like the recorded one; perception is not reproducible from it. Raises DamageError when
    the picture is damaged."""
    import cv2  # `cv2` and `numpy` take a third of a second, and few readers of captures need a picture
    import numpy as np

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


ENCODING = "jsonschema"


class TypeSchema(NamedTuple):
    name: str
    encoding: str
    data: bytes


@cache
def schema_of(kind: type[msgspec.Struct]) -> TypeSchema:
    """The JSON schema of a message's type: an object at the root, binary fields as `contentEncoding: binary`."""
    whole = msgspec.json.schema(kind)
    parts = dict(whole.get("$defs", {}))
    root = parts.pop(kind.__name__, whole)
    found = {"$schema": "https://json-schema.org/draft/2020-12/schema", **root}
    if parts:
        found["$defs"] = parts
    return TypeSchema(kind.__name__, ENCODING, json.dumps(_binary(found), separators=(",", ":")).encode())


def _binary(node: Any) -> Any:
    """MessagePack carries bytes as they are, so they are `binary` and not `base64`."""
    if isinstance(node, dict):
        return {
            name: "binary" if (name, value) == ("contentEncoding", "base64") else _binary(value)
            for name, value in node.items()
        }
    return [_binary(item) for item in node] if isinstance(node, list) else node


MSGPACK, JSON, OTHER = "msgpack", "json", "application/octet-stream"
Read = Callable[[bytes | memoryview], msgspec.Struct]


@cache
def reader_of(name: str, schema: str | None) -> Read | None:
    """Returns a decoder for the payloads of a topic (the key without the robot) by the recorded schema's name; None
    when no type is known for the key. It returns lossy frames as frames."""
    topic = topic_named(name)
    if topic is not None and (schema is None or topic.type.__name__ in (schema, todays_name(schema))):
        kind: type[Message] = topic.type
        decode = msgspec.msgpack.Decoder(kind).decode
        return lambda payload: decode(todays_payload(kind.__name__, payload))
    if schema == Alive.__name__:
        return msgspec.msgpack.Decoder(Alive).decode
    if schema == LossyFrame.__name__:
        decoder = msgspec.msgpack.Decoder(LossyFrame)
        return lambda payload: expand(decoder.decode(payload))
    return None
