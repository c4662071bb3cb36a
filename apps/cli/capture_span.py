"""`--from` and `--to` of the commands that take a part of a capture."""

from __future__ import annotations

from math import isfinite

from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.errors import ConfigError


def check_span(capture: Capture, start_s: float | None, end_s: float | None) -> None:
    """Both are seconds from the capture's start. Raises ConfigError with what is wrong with which of them."""
    length_s = (capture.end_ns - capture.start_ns) / NS
    for option, given_s in (("--from", start_s), ("--to", end_s)):
        if given_s is not None and not (isfinite(given_s) and given_s >= 0):
            raise ConfigError(f"{option} {given_s:g}: give seconds from the capture's start, 0 or more")
    if start_s is not None and start_s > length_s:
        raise ConfigError(
            f"--from {start_s:g}: {capture.path} lasts {length_s:.3f} s, so there is nothing from there on"
        )
    if end_s is not None and end_s <= (start_s or 0.0):
        before = "the capture's start" if not start_s else f"--from {start_s:g}"
        raise ConfigError(
            f"--to {end_s:g}: it is exclusive and must be later than {before}, or there is nothing between"
        )
