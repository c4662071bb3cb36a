"""Key expressions, as zenoh has them: `*` is one chunk, `**` any number of chunks (none included)."""

from __future__ import annotations

from functools import lru_cache


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


def covers(wide: str, narrow: str) -> bool:
    """Whether one of two key expressions is in the other, treating the narrow one's `*` as a chunk."""
    return wide == narrow or matches(wide, narrow)
