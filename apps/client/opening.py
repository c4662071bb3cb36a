"""`cocoro.open`: a capture as arrays, by its file or by the name that `cocoro capture list` shows."""

from __future__ import annotations

from os import PathLike, fspath

from apps.captures import shelf
from cocoro.capture.tables import Tables


def open(capture: str | PathLike[str] = "latest") -> Tables:
    """Opens a capture: a file, or a name such as `latest` or `fetch red_can`, as every command takes it.

    `cocoro.open("fetch")["base/state"]["speed_mps"]` is a column of a topic. Raises CaptureError when the file cannot
    be read or is not MCAP.
    """
    return Tables.open(shelf.find(fspath(capture)))
