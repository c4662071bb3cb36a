"""Payloads for people: any MessagePack map as text and as JSON, whatever type it is, and what is wrong with it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import msgpack
import msgspec

from cocoro.bus.base import Payload
from cocoro.installed import topic_named

SHOWN = 12
"""Elements of a list that are shown unless all are wanted."""
HEAD = ("stamp_ns", "seq", "incarnation")
"""What every message says of itself: in the headline, not among the fields."""


class DecodedPayload(NamedTuple):
    type: str
    """The name of the topic's type; empty for a key that the table of topics does not have."""
    value: Any
    """Maps, lists, texts, numbers, bytes; None when the payload is no MessagePack."""
    problem: str
    """Why a reader of the topic's type would reject it; empty when it would not."""


def read(payload: Payload, topic_name: str) -> DecodedPayload:
    """Decode a payload without knowing its type; where the table of topics does, check it too. Never raises."""
    topic = topic_named(topic_name)
    name = topic.type.__name__ if topic is not None else ""
    try:
        value = msgpack.unpackb(payload, strict_map_key=False, timestamp=3, unicode_errors="replace")
    except Exception as error:  # the library raises what it likes for what is broken
        start = bytes(payload[:16]).hex(" ")
        return DecodedPayload(
            name, None, f"no MessagePack ({error or type(error).__name__}): {len(payload)} bytes, {start}"
        )
    if topic is None:
        return DecodedPayload("", value, "")
    if len(payload) > topic.max_bytes:
        return DecodedPayload(name, value, f"{len(payload)} bytes, at most {topic.max_bytes} are taken")
    try:
        msgspec.msgpack.decode(payload, type=topic.type)
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
        return DecodedPayload(name, value, f"no good {name}: {error}")
    return DecodedPayload(name, value, "")


def jsonable(value: Any) -> Any:
    """The same with what JSON does not have as text: bytes by their number, NaN and infinity by their names."""
    if isinstance(value, dict):
        return {key if isinstance(key, str) else _text(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, str | int | float):
        return value
    return _text(value)


def lines(value: Any, everything: bool = False, indent: int = 2) -> Iterator[str]:
    """A value as lines, a field each; long lists end in how many more there are, unless everything is wanted."""
    shift = " " * indent
    if isinstance(value, dict):
        for key, item in value.items():
            if _is_block(item):
                yield f"{shift}{_text(key)}:"
                yield from lines(item, everything, indent + 2)
            else:
                yield f"{shift}{_text(key)}: {_inline(item, everything)}"
    elif isinstance(value, list) and _is_block(value):
        some = value if everything else value[:SHOWN]
        for item in some:
            first, *rest = list(lines(item, everything, 0)) or ["{}"]
            yield f"{shift}- {first}"
            yield from (f"{shift}  {line}" for line in rest)
        if len(some) < len(value):
            yield f"{shift}({len(value) - len(some)} more of {len(value)})"
    else:
        yield f"{shift}{_inline(value, everything)}"


def _is_block(value: Any) -> bool:
    """It takes lines of its own: a map with anything in it, or a list with such a map in it."""
    if isinstance(value, list):
        return any(isinstance(item, dict) and item for item in value)
    return isinstance(value, dict) and bool(value)


def _inline(value: Any, everything: bool) -> str:
    if isinstance(value, list):
        some = value if everything else value[:SHOWN]
        texts = [_inline(item, everything) for item in some]
        if len(some) < len(value):
            texts.append(f"({len(value) - len(some)} more of {len(value)})")
        return f"[{', '.join(texts)}]"
    return _text(value)


def _text(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, bytes):
        return f"<{len(value)} bytes>"
    if isinstance(value, str):
        return value if value and value.isprintable() and value == value.strip() else repr(value)
    return str(value)
