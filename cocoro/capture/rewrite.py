"""A capture written anew: whole where it was not, and perhaps shorter or packed tighter. Payloads stay as they are."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from cocoro.capture.compression import Packer
from cocoro.capture.errors import CaptureError
from cocoro.capture.info import missing_of
from cocoro.capture.keys import KeyInfo
from cocoro.capture.reader import Capture, Record
from cocoro.capture.schema import TypeSchema
from cocoro.capture.writer import TALLY, Entry, Limits, Missing, Writer

REPAIRED = "repaired"
"""The metadata record of what was written anew, and had not been whole: what was wrong with it."""


class Rewritten(NamedTuple):
    path: Path
    messages: int
    size_bytes: int
    problems: tuple[str, ...]
    """What of the original could not be read, and so is missing."""


def rewrite(
    capture: Capture,
    out: Path,
    packer: Packer,
    *,
    keep: Callable[[Record], bool] = lambda _: True,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Rewritten:
    """Write what can be read of a capture to a new file. Raises CaptureError, and leaves no half of a file then."""
    if out.exists():
        raise CaptureError(f"{out} is there already; remove it, or choose another name")
    missing = Missing(*missing_of(capture))
    writer = Writer(lambda _: out, packer, Limits(), lambda key, _: info_in(capture, key), lambda: missing)
    try:
        for name, entries in capture.metadata.items():
            if name != TALLY:
                writer.remember(name, entries)
        for record in capture.messages(start_ns=start_ns, end_ns=end_ns):
            if keep(record):
                key, log_ns, publish_ns, sequence, payload = record
                writer.put(Entry(key, sequence, log_ns, publish_ns, bytes(payload)))
        if capture.problems or capture.ending:
            problems = json.dumps(capture.problems)
            writer.remember(REPAIRED, {"file": capture.path.name, "ending": capture.ending, "problems": problems})
        writer.close()
    except BaseException:
        out.unlink(missing_ok=True)
        raise
    return Rewritten(out, writer.messages, out.stat().st_size, tuple(capture.problems))


def info_in(capture: Capture, key: str) -> KeyInfo:
    """What a capture says of a key."""
    channel, schema = capture.keys[key], capture.schema(key)
    kind = None if schema is None else TypeSchema(schema.name, schema.encoding, schema.data)
    return KeyInfo(channel.encoding, kind, dict(channel.metadata))
