"""A capture written anew: whole where it was not, and perhaps shorter or packed tighter. Payloads stay as they are, and
so do channels and schemas with their numbers, metadata and attachments; records of kinds that are not MCAP's own are
left out. A file of another profile keeps that, and nothing of this project's conventions is put into it."""

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
from services.capture.file import CaptureFile, Packer
from services.capture.keys import KeyInfo
from services.capture.writer import sync_and_close

REPAIRED = "repaired"
"""The metadata record of what was written anew, and had not been whole: what was wrong with it."""


class Rewritten(NamedTuple):
    path: Path
    messages: int
    attachments: int
    size_bytes: int
    problems: tuple[str, ...]
    """Parts of the original that could not be read, and so are missing."""
    notes: tuple[str, ...]
    """Records of the original that are not of MCAP's own kinds, and so were left out."""


def rewrite(
    capture: Capture,
    out: Path,
    packer: Packer,
    *,
    keep: Callable[[Record], bool] | None = None,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Rewritten:
    """Write what can be read of a capture to a new file; with `keep` only the messages that it says, and their
    channels. Raises CaptureError, and leaves no half of a file then."""
    if out.exists():
        raise CaptureError(f"{out} is there already; remove it, or choose another name")
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
    """How many messages."""
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
    """Encoding, schema and metadata of a channel, as a capture has them."""
    found, schema = capture.channels[channel], capture.schema(channel)
    kind = None if schema is None else TypeSchema(schema.name, schema.encoding, schema.data)
    return KeyInfo(found.message_encoding, kind, dict(found.metadata))
