"""Decodes payloads of any type, checks those of known types, and renders them as text and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import msgpack
import msgspec

from cocoro.bus.base import Payload
from cocoro.installed import topic_named

SHOWN = 12
"""Elements of a list that are shown by default."""
HEAD = ("stamp_ns", "seq", "incarnation")
"""Fields that every message has; `echo` shows them in the headline."""


class DecodedPayload(NamedTuple):
    type: str
    """The name of the topic's type; empty for a key that the table of topics does not have."""
    value: Any
    """Maps, lists, texts, numbers, bytes; None when the payload is not MessagePack."""
    problem: str
    """Why a reader of the topic rejects it; empty when it accepts it."""


def read(payload: Payload, topic_name: str) -> DecodedPayload:
    """Decode a payload without knowing its type; where the table of topics does, check it too. Never raises."""
    topic = topic_named(topic_name)
    name = topic.type.__name__ if topic is not None else ""
    try:
        value = msgpack.unpackb(payload, strict_map_key=False, timestamp=3, unicode_errors="replace")
    except Exception as error:  # the library raises many types of errors
        start = bytes(payload[:16]).hex(" ")
        return DecodedPayload(
            name, None, f"not MessagePack ({error or type(error).__name__}): {len(payload)} bytes, {start}"
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
    """The value with everything that JSON lacks as text: bytes by their number, NaN and infinity by their names."""
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
    """Renders a value, one line for each field; long lists are cut unless `everything` is set."""
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
    """Whether a value needs lines of its own: a non-empty map, or a list that contains one."""
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
