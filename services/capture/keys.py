"""Selection of the keys to record, and their form in the file: key filter, channel information, lossy frames."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from typing import NamedTuple

import msgspec

from cocoro.bus.base import Qos
from cocoro.capture.types import JSON, MADE_HERE, MSGPACK, OTHER, Alive, LossyFrame, TypeSchema, schema_of
from cocoro.errors import ConfigError
from cocoro.installed import all_topics, topic_named
from cocoro.keys import matches
from cocoro.messages import Frame, Message
from cocoro.topics import FRAME

FRAMES = "frames"
"""Stands for all keys that carry pictures, in place of a key expression."""


class KeyInfo(NamedTuple):
    """Encoding, schema and metadata of a channel."""

    encoding: str
    schema: TypeSchema | None
    metadata: dict[str, str]


def info_of(key: str, robot: str, payload: bytes | memoryview) -> KeyInfo:
    """Channel information of a key: from the topic table, else guessed from the first payload."""
    topic = topic_named(key.removeprefix(f"{robot}/")) if key.startswith(f"{robot}/") else None
    if topic is not None:
        rate = "" if topic.rate_hz is None else f"{topic.rate_hz:g}"
        metadata = {"publisher": topic.publisher, "qos": topic.qos.value, "rate_hz": rate}
        kind: type[Message] = topic.type
        return KeyInfo(MSGPACK, schema_of(kind), metadata)
    return KeyInfo(_encoding(payload), None, {})


ALIVE_INFO = KeyInfo(MSGPACK, schema_of(Alive), {"publisher": MADE_HERE})


def _encoding(payload: bytes | memoryview) -> str:
    try:
        msgspec.msgpack.decode(payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        pass
    else:
        return MSGPACK
    try:
        json.loads(bytes(payload))
    except (ValueError, RecursionError):
        return OTHER
    return JSON


class KeyFilter:
    """The set of keys that an operator selects: those matching `only` (all when it is empty) except those matching
    `without`.

    Both are key expressions with or without the robot's name, or `frames`. Raises ConfigError for anything else.
    """

    def __init__(self, robot: str, only: Iterable[str] = (), without: Iterable[str] = ()) -> None:
        self._only = [expr for text in only for expr in _expressions(text, robot)]
        self._without = [expr for text in without for expr in _expressions(text, robot)]

    def __contains__(self, key: object) -> bool:
        if not isinstance(key, str) or any(matches(expr, key) for expr in self._without):
            return False
        return not self._only or any(matches(expr, key) for expr in self._only)


def _expressions(text: str, robot: str) -> list[str]:
    if text == FRAMES:
        return [topic.key(robot) for topic in all_topics() if topic.qos is Qos.FRAME]
    if not text or any(not chunk or ("*" in chunk and chunk not in ("*", "**")) for chunk in text.split("/")):
        raise ConfigError(f"{text!r} is no key expression; write it as base/** or calliope/*/health, or {FRAMES}")
    return [text, f"{robot}/{text}"]


_decoder = msgspec.msgpack.Decoder(Frame)


def lossy(quality: int) -> Callable[[QueuedMessage], PreparedMessage]:
    """Returns a function that replaces frames by lossy frames of this JPEG quality and leaves other messages alone."""

    def prepare(message: QueuedMessage) -> PreparedMessage:
        if not message.key.endswith(f"/{FRAME.name}"):
            return PreparedMessage(message, None)
        try:
            frame = _decoder.decode(message.payload)
        except (msgspec.MsgspecError, ValueError):
            return PreparedMessage(message, None)
        payload = msgspec.msgpack.encode(compress(frame, quality))
        return PreparedMessage(message._replace(payload=payload), schema_of(LossyFrame))

    return prepare


def compress(frame: Frame, quality: int) -> LossyFrame:
    import cv2  # slow to import, and most recorders keep the pictures as they are
    import numpy as np

    pixels = np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return LossyFrame(
        stamp_ns=frame.stamp_ns,
        seq=frame.seq,
        incarnation=frame.incarnation,
        width=frame.width,
        height=frame.height,
        colour_jpeg=jpeg.tobytes(),
        depth=frame.depth,
    )


class QueuedMessage(NamedTuple):
    """A message on its way into a capture."""

    key: str
    sequence: int
    log_ns: int
    publish_ns: int
    payload: bytes
    info: KeyInfo | None = None
    """Channel information, where the topic table and the payload do not give it."""
    channel: int | None = None
    """Distinguishes several channels of one key. It is not the channel number in the file."""


class PreparedMessage(NamedTuple):
    """A message as it is to be written."""

    message: QueuedMessage
    schema: TypeSchema | None
    """Schema of the payload where it differs from the key's."""
