"""Options whose values have a form of their own."""

from __future__ import annotations

import re
from collections.abc import Iterable

from cocoro.errors import ConfigError


def frames_of(text: str) -> dict[str, int | float]:
    """'320x240@15' as width, height and frame_rate_hz; without '@15' just the size. Raises ConfigError."""
    match = re.fullmatch(r"(\d+)x(\d+)(?:@(\d+(?:\.\d+)?))?", text)
    if match is None:
        raise ConfigError(f"--frames {text}: write it as WIDTHxHEIGHT@HZ, for example 320x240@15")
    size: dict[str, int | float] = {"width": int(match[1]), "height": int(match[2])}
    return size | ({"frame_rate_hz": float(match[3])} if match[3] else {})


def latencies_of(texts: Iterable[str]) -> dict[str, float]:
    """'perception=0.5' and others like it, as seconds by name. Raises ConfigError."""
    found: dict[str, float] = {}
    for text in texts:
        name, equals, seconds = text.partition("=")
        try:
            if not name or not equals:
                raise ValueError
            found[name] = float(seconds)
        except ValueError:
            raise ConfigError(f"--latency {text}: write it as NAME=SECONDS, for example perception=0.5") from None
    return found
