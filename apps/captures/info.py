"""Reports on a capture: channels with counts, rates, gaps and losses, and the capture's origin."""

from __future__ import annotations

import json
from typing import Any

import msgspec

from apps.captures.compare import changes
from cocoro.capture import mcap
from cocoro.capture.conventions import TALLY, KeyTally, tally_names
from cocoro.capture.former import is_former, todays_name
from cocoro.capture.mcap import DamageError
from cocoro.capture.reader import Capture
from cocoro.capture.types import MADE_HERE, LossyFrame, schema_of
from cocoro.clock import NS
from cocoro.installed import topic_named
from cocoro.messages import Message
from cocoro.topics import RECORDING
from services.capture.file import packed
from services.capture.writer import Missing

MESSAGE_HEAD_BYTES = mcap.MESSAGE_HEAD.size


class KeyReport(msgspec.Struct, kw_only=True):
    """One channel. Most keys have one."""

    key: str
    channel: int
    """Number in the file."""
    encoding: str
    """Message encoding."""
    type: str
    """Name of the recorded schema; '' without one."""
    messages: int
    rate_hz: float
    size_bytes: int
    longest_gap_s: float
    longest_gap_from_s: float
    """Since the capture's start."""
    lost: int = 0
    """Gaps in the sequence numbers, since the recorder's start."""
    dropped: int = 0
    """Received but not written because the queue was full, since the recorder's start."""
    left_out: int = 0
    """Left out by intention while nothing happened. No loss."""
    changed: tuple[str, ...] = ()
    """Differences of today's type from the recorded schema, in words."""


class AttachmentReport(msgspec.Struct, kw_only=True):
    name: str
    media_type: str
    size_bytes: int
    log_ns: int
    created_ns: int
    """0: unknown."""


class CaptureReport(msgspec.Struct, kw_only=True):
    path: str
    size_bytes: int
    raw_bytes: int
    """Before compression; 0: unknown."""
    closed: bool
    ending: str
    """Why the capture may be shorter than the run; '' when it was closed."""
    checked: bool
    """The counts come from reading every byte, not from the file's own statements."""
    problems: tuple[str, ...]
    robot: str
    start_ns: int
    """Log time of the first message."""
    duration_s: float
    messages: int
    keys: tuple[KeyReport, ...]
    attachments: tuple[AttachmentReport, ...]
    notes: tuple[str, ...]
    """Contradictions and skipped records, in words. They are no damage."""
    metadata: dict[str, dict[str, Any]]


def report(capture: Capture, check: bool = False) -> CaptureReport:
    """Report on a capture.

    For a complete capture the counts come from its tally, where that agrees with the statistics and chunks.
    Otherwise, and with `check`, all messages are read and counted. Raises CaptureError when the disk fails.
    """
    stated = _stated_tallies(capture) if capture.whole and capture.summarised else None
    tallies = stated if stated is not None and not check else _counted(capture)
    checked = check or tallies is not stated
    if checked:
        capture.check()
    missing = missing_of(capture)
    notes = [*capture.notes, *_contradictions(capture), *left_out_notes(capture, missing)]
    names = sorted(capture.keys)
    keys = tuple(
        _key_report(capture, channel, tallies[channel], missing) for key in names for channel in capture.keys[key]
    )
    return CaptureReport(
        path=str(capture.path),
        size_bytes=capture.size_bytes,
        raw_bytes=sum(tally.size_bytes for tally in tallies.values()),
        closed=capture.closed,
        ending=capture.ending,
        checked=checked,
        problems=tuple(capture.problems),
        robot=capture.robot,
        start_ns=capture.start_ns,
        duration_s=(capture.end_ns - capture.start_ns) / NS,
        messages=sum(tally.messages for tally in tallies.values()),
        keys=keys,
        attachments=tuple(
            AttachmentReport(
                name=index.name,
                media_type=index.media_type,
                size_bytes=index.data_size,
                log_ns=index.log_time,
                created_ns=index.create_time,
            )
            for index in capture.attachments
        ),
        notes=tuple(notes),
        metadata={
            name: {entry: _parsed_json(value) for entry, value in entries.items()}
            for name, entries in capture.metadata.items()
            if name != TALLY or not capture.follows_conventions
        },
    )


def _stated_tallies(capture: Capture) -> dict[int, KeyTally] | None:
    """The tally by channel number; None when it does not belong to this file, since metadata may have been copied from
    another one. It must agree with the statistics on each channel's messages and on the first and last log time,
    and with the chunks on the number of bytes."""
    entries, statistics = capture.metadata.get(TALLY), capture.statistics
    if entries is None or statistics is None:
        return None
    try:
        stated = msgspec.json.decode(entries["keys"], type=dict[str, KeyTally])
    except (KeyError, msgspec.MsgspecError):
        return None
    names = tally_names(capture.channels)
    if stated.keys() != set(names.values()):
        return None
    tallies = {id: stated[name] for id, name in names.items()}
    busy = [tally for tally in tallies.values() if tally.messages]
    first_ns = min((tally.first_ns for tally in busy), default=0)
    last_ns = max((tally.last_ns for tally in busy), default=0)
    counts = statistics.channel_message_counts
    if any(tally.messages != counts.get(id, 0) for id, tally in tallies.items()):
        return None
    if (first_ns, last_ns) != (statistics.message_start_time, statistics.message_end_time):
        return None
    declared = len(packed(*capture.schemas.values(), *capture.channels.values()))
    messages = sum(tally.size_bytes + MESSAGE_HEAD_BYTES * tally.messages for tally in busy)
    return tallies if messages + declared == capture.chunk_bytes else None


def _counted(capture: Capture) -> dict[int, KeyTally]:
    tallies = {channel: KeyTally() for channel in capture.channels}
    for record in capture.messages():
        tallies[record.channel].add(record.log_ns, len(record.payload))
    return tallies


def _contradictions(capture: Capture) -> list[str]:
    """False statements of the file about itself, in words. MCAP readers ignore them, so they are no damage."""
    if capture.problems:
        return []
    found = []
    if (
        capture.follows_conventions
        and TALLY in capture.metadata
        and capture.summarised
        and _stated_tallies(capture) is None
    ):
        found.append(f"its metadata {TALLY!r} belongs to another file, so the messages were counted")
    return found


def missing_of(capture: Capture) -> Missing:
    """Dropped, lost and left out messages by key, from the tally of a complete file, else from the recorder's progress
    messages."""
    stated = capture.metadata.get(TALLY)
    counts = dict[str, int]
    try:
        if stated is not None:
            return Missing(*(msgspec.json.decode(stated.get(name, "{}"), type=counts) for name in Missing._fields))
        first: counts | None = None
        found = Missing({}, {})
        for record in capture.messages(f"*/{RECORDING.name.partition('/')[2]}"):
            progress = capture.decode(record)
            left_out = progress.get("left_out", {})
            first = left_out if first is None else first
            more = {key: count - first.get(key, 0) for key, count in left_out.items() if count > first.get(key, 0)}
            found = Missing(progress["dropped"], progress["lost"], more)
        return found
    except (KeyError, TypeError, AttributeError, msgspec.MsgspecError, DamageError):
        return Missing({}, {})


def left_out_notes(capture: Capture, missing: Missing | None = None) -> list[str]:
    """Describe in one line, or none, the messages that were left out by intention. `missing` is the capture's own
    account of them, where it was read already."""
    missing = missing or (missing_of(capture) if capture.left_out else Missing({}, {}))
    if not missing.left_out:
        return []
    counts = ", ".join(
        f"{count} of {key.removeprefix(f'{capture.robot}/')}" for key, count in sorted(missing.left_out.items())
    )
    spans = [f"{(a - capture.start_ns) / NS:.1f} to {(b - capture.start_ns) / NS:.1f} s" for a, b in capture.left_out]
    when = f" (from {', '.join(spans[:3])}{' and later' if len(spans) > 3 else ''})" if spans else ""
    return [f"while nothing happened{when}, these large messages were left out, which is no loss: {counts}"]


def _key_report(capture: Capture, channel: int, tally: KeyTally, missing: Missing) -> KeyReport:
    span_s = (tally.last_ns - tally.first_ns) / NS
    schema = capture.schema(channel)
    key = capture.channels[channel].topic
    first = channel == capture.keys[key][0]  # missing messages are counted by key, so they go to its first channel
    return KeyReport(
        key=key,
        channel=channel,
        encoding=capture.channels[channel].message_encoding,
        type="" if schema is None else schema.name,
        messages=tally.messages,
        rate_hz=(tally.messages - 1) / span_s if span_s > 0 else 0.0,
        size_bytes=tally.size_bytes,
        longest_gap_s=tally.longest_gap_ns / NS,
        longest_gap_from_s=max(tally.longest_gap_from_ns - capture.start_ns, 0) / NS,
        lost=missing.lost.get(key, 0) if first else 0,
        dropped=missing.dropped.get(key, 0) if first else 0,
        left_out=missing.left_out.get(key, 0) if first else 0,
        changed=tuple(changed_since(capture, channel)),
    )


def changed_since(capture: Capture, channel: int) -> list[str]:
    """Differences of today's type of a channel's key from the recorded schema, in words."""
    schema, key = capture.schema(channel), capture.channels[channel].topic
    topic = topic_named(key.removeprefix(f"{capture.robot}/"))
    if schema is None or topic is None or capture.channels[channel].metadata.get("publisher") == MADE_HERE:
        return []
    if schema.name == LossyFrame.__name__:
        return []
    if todays_name(schema.name) != topic.type.__name__:
        return [f"its type is {topic.type.__name__} today"]
    if is_former(schema.name, schema.data):
        return [f"{schema.name} has changed: its former shape is converted"]
    kind: type[Message] = topic.type
    return [change.text for change in changes(schema.data, schema_of(kind).data)]


def _parsed_json(value: str) -> Any:
    """Parse metadata that is JSON; other text stays as it is."""
    if value[:1] in ("{", "["):
        try:
            return json.loads(value)
        except ValueError:
            pass
    return value
