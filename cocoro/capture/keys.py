"""What a capture says of each key, and which keys are meant by what an operator writes."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import NamedTuple

import msgspec

from cocoro.bus.base import Qos
from cocoro.bus.keys import matches
from cocoro.capture.schema import TypeSchema, schema_of
from cocoro.errors import ConfigError
from cocoro.installed import topic_named
from cocoro.messages import Message
from cocoro.topics import TOPICS

MSGPACK, JSON, OTHER = "msgpack", "json", "application/octet-stream"
MADE_HERE = "recorder"
"""The channel metadata `publisher` of what was never published: the recorder's own notes."""
FRAMES = "frames"
"""In place of a key expression: all that carries pictures."""


class Alive(Message):
    """A liveliness token came or went, as the recorder saw it: a service of the robot, by its key."""

    alive: bool


class KeyInfo(NamedTuple):
    """What stands in a channel beside its key."""

    encoding: str
    schema: TypeSchema | None
    metadata: dict[str, str]


def info_of(key: str, robot: str, payload: bytes | memoryview) -> KeyInfo:
    """Of a key on the mesh: from the table of topics; what is not in it is judged by its first payload."""
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


class Choice:
    """Which keys an operator means: those of `only` (all, when there is none), but for those of `without`.

    Each is a key expression with or without the robot's name, or `frames`. Raises ConfigError for what is none.
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
        return [topic.key(robot) for topic in TOPICS if topic.qos is Qos.FRAME]
    if not text or any(not chunk or ("*" in chunk and chunk not in ("*", "**")) for chunk in text.split("/")):
        raise ConfigError(f"{text!r} is no key expression; write it as base/** or calliope/*/health, or {FRAMES}")
    return [text, f"{robot}/{text}"]
