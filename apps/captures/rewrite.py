"""Writes a capture again: complete where it was damaged, and on request shortened or compressed harder.

Payloads, channels and schemas with their numbers, metadata and attachments stay as they are; records of kinds that
MCAP does not define are left out. A file of another profile keeps it and gets none of this project's conventions.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from apps.captures.info import missing_of
from cocoro.capture.conventions import CaptureError
from cocoro.capture.mcap import DamageError
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import TypeSchema
from services.capture.file import CaptureFile
from services.capture.keys import KeyInfo
from services.capture.packing import Packer
from services.capture.writer import sync_and_close

REPAIRED = "repaired"
"""Metadata of a repaired capture: what was wrong with the original."""


class Rewritten(NamedTuple):
    path: Path
    messages: int
    attachments: int
    size_bytes: int
    problems: tuple[str, ...]
    """Parts of the original that could not be read and are missing."""
    notes: tuple[str, ...]
    """Records of the original that were left out because MCAP does not define their kind."""


def rewrite(
    capture: Capture,
    out: Path,
    packer: Packer,
    *,
    keep: Callable[[Record], bool] | None = None,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Rewritten:
    """Write everything readable of a capture to a new file; with `keep` only the messages for which it is true, and
    their channels. `start_ns` and `end_ns` are log times, the end exclusive.

    Raises CaptureError, and then leaves no file.
    """
    if out.exists():
        raise CaptureError(f"{out} exists; remove it, or choose another name")
    try:
        file = CaptureFile(out, packer, capture.profile)
    except OSError as error:
        raise CaptureError(f"{out}: {error.strerror or error}") from error
    try:
        count = _copied(capture, file, keep, start_ns, end_ns)
    except BaseException as error:
        file.abandon()
        out.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise CaptureError(f"{out}: {error.strerror or error}") from error
        raise
    sync_and_close(file.fileno())
    problems, attachments = tuple(capture.problems), file.attachments
    return Rewritten(out, count, attachments, file.size_bytes, problems, tuple(capture.notes))


def _copied(
    capture: Capture,
    file: CaptureFile,
    keep: Callable[[Record], bool] | None,
    start_ns: int | None,
    end_ns: int | None,
) -> int:
    """Returns the number of messages."""
    for name, entries in capture.metadata_records:
        file.metadata(name, entries)
    if keep is None:
        for schema in capture.schemas.values():
            file.schema(schema)
        for channel in capture.channels.values():
            file.channel(channel)
    count, known = 0, set(capture.channels) if keep is None else set()
    for record in capture.messages(start_ns=start_ns, end_ns=end_ns):
        if keep is not None and not keep(record):
            continue
        if record.channel not in known:
            known.add(record.channel)
            of_it = capture.schema(record.channel)
            if of_it is not None:
                file.schema(of_it)
            file.channel(capture.channels[record.channel])
        file.add(record.channel, record.sequence, record.log_ns, record.publish_ns, bytes(record.payload))
        count += 1
    for index in capture.attachments:
        try:
            file.attachment(capture.attachment(index))
        except DamageError as damage:
            capture.add_problem(f"at byte {index.offset}: {damage}")
    if capture.problems or capture.ending:
        problems = json.dumps(capture.problems)
        file.metadata(REPAIRED, {"file": capture.path.name, "ending": capture.ending, "problems": problems})
    if capture.follows_conventions:
        file.tally(*missing_of(capture))
    file.finish()
    return count


def info_in(capture: Capture, channel: int) -> KeyInfo:
    """Encoding, schema and metadata of a capture's channel."""
    found, schema = capture.channels[channel], capture.schema(channel)
    kind = None if schema is None else TypeSchema(schema.name, schema.encoding, schema.data)
    return KeyInfo(found.message_encoding, kind, dict(found.metadata))
