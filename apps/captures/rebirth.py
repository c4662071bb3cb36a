"""Recorded messages sent again, in a time line that has gone back.

A reader takes no message twice from one start of a publisher. So what is played a second time comes from a new start:
its incarnation is another, and so is each that the message speaks of, in `*incarnation` and in the lists of a
StepRecord. The first time, payloads stay as they are, to the byte.
"""

from __future__ import annotations

from typing import Any

import msgspec

_BITS = 48
"""Incarnations are drawn from so many."""
_PARTS = ("consumed", "produced")


def reborn(payload: bytes | memoryview, passes: int) -> bytes | memoryview:
    """The payload for a time line that has gone back so often. What is no MessagePack map stays as it is."""
    if passes == 0:
        return payload
    try:
        message = msgspec.msgpack.decode(payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return payload
    return msgspec.msgpack.encode(_reborn(message, passes)) if isinstance(message, dict) else payload


def with_rate(payload: bytes | memoryview, rate: float) -> bytes | memoryview:
    """A clock's message, where time goes `rate` times as fast as it was recorded."""
    if rate == 1.0:
        return payload
    try:
        message = msgspec.msgpack.decode(payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return payload
    if not isinstance(message, dict) or not isinstance(message.get("rate"), int | float):
        return payload
    return msgspec.msgpack.encode({**message, "rate": message["rate"] * rate})


def _reborn(message: dict[Any, Any], passes: int) -> dict[Any, Any]:
    found: dict[Any, Any] = {}
    for name, value in message.items():
        if isinstance(name, str) and name.endswith("incarnation") and isinstance(value, int):
            found[name] = _next(value, passes)
        elif name in _PARTS and isinstance(value, list):
            found[name] = [_part(part, passes) for part in value]
        else:
            found[name] = value
    return found


def _part(part: Any, passes: int) -> Any:
    if isinstance(part, list) and len(part) == 3 and isinstance(part[1], int):
        return [part[0], _next(part[1], passes), part[2]]
    return part


def _next(incarnation: int, passes: int) -> int:
    return incarnation + (passes << _BITS)
