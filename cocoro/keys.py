"""Keys and key expressions, as zenoh has them, and the liveliness keys of a robot.

A key is `<robot>/<service>/<topic>`. In a key expression, `*` stands for one chunk and `**` for any number of chunks
(also none).
"""

from __future__ import annotations

from functools import lru_cache


def alive_key(robot: str, service: str = "*") -> str:
    """The liveliness token of a service, declared from `Node.ready` to its end; by default of all services."""
    return f"{robot}/{service}/alive"


def recorder_key(robot: str, service: str = "*") -> str:
    """The liveliness token of a recorder, declared once it receives everything; by default of all recorders."""
    return f"{robot}/{service}/recorder"


def asker_key(robot: str, asker: str = "*") -> str:
    """The liveliness token of an asker, declared before the request and dropped when he has gone; by default of all."""
    return f"{robot}/{asker}/asker"


def service_of(key: str) -> str:
    """The service in a key `<robot>/<service>/...`; empty for a key of one chunk."""
    return key.partition("/")[2].partition("/")[0]


@lru_cache(maxsize=4096)
def matches(keyexpr: str, key: str) -> bool:
    """Whether a key (without wildcards) is in a key expression."""
    return _matches(keyexpr.split("/"), key.split("/"))


def _matches(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    if pattern[0] == "**":
        return any(_matches(pattern[1:], chunks[i:]) for i in range(len(chunks) + 1))
    return bool(chunks) and pattern[0] in ("*", chunks[0]) and _matches(pattern[1:], chunks[1:])
