"""The report on a capture: its channels with their counts, rates, gaps and losses, and where it came from."""

from __future__ import annotations

import json
from collections.abc import Mapping
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

MESSAGE_HEAD_BYTES = mcap.MESSAGE_HEAD.size


class KeyReport(msgspec.Struct, kw_only=True):
    """One channel of a key; most keys have one."""

    key: str
    channel: int
    """Its number in the file."""
    encoding: str
    """Message encoding, as the file has it."""
    type: str
    """The recorded schema's name; '' where there is none."""
    messages: int
    rate_hz: float
    size_bytes: int
    longest_gap_s: float
    longest_gap_from_s: float
    """Since the capture's start."""
    lost: int = 0
    """Sent and never received: gaps in the sequence, since the recorder's start."""
    dropped: int = 0
    """Received, and not written for want of room, since the recorder's start."""
    changed: tuple[str, ...] = ()
    """What is different in today's type."""


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
    """Before compression; 0 when that is not known."""
    closed: bool
    ending: str
    """Why it may be shorter than the run was; '' when it was closed."""
    checked: bool
    """Every byte was read for this report, and not only what the file says of itself."""
    problems: tuple[str, ...]
    robot: str
    start_ns: int
    """Log time of the first message."""
    duration_s: float
    messages: int
    keys: tuple[KeyReport, ...]
    attachments: tuple[AttachmentReport, ...]
    notes: tuple[str, ...]
    """Contradictions and records that are passed by, in words; no damage."""
    metadata: dict[str, dict[str, Any]]


def report(capture: Capture, check: bool = False) -> CaptureReport:
    """Report on a capture. The counts of a whole capture are those of its own tally (checksums vouch for it), where
    that agrees with its statistics and chunks. Of any other capture, and with `check`, all is read and counted."""
    told = _told_tallies(capture) if capture.whole and capture.summarised else None
    tallies = told if told is not None and not check else _counted(capture)
    checked = check or tallies is not told
    if checked:
        capture.check()
    notes = [*capture.notes, *_contradictions(capture)]
    dropped, lost = missing_of(capture)
    names = sorted(capture.keys)
    keys = tuple(
        _key_report(capture, channel, tallies[channel], dropped, lost) for key in names for channel in capture.keys[key]
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
            name: {entry: _plain(value) for entry, value in entries.items()}
            for name, entries in capture.metadata.items()
            if name != TALLY or not capture.follows_conventions
        },
    )


def _told_tallies(capture: Capture) -> dict[int, KeyTally] | None:
    """By channel, as the tally has it; None where it is not of this file: metadata may have been copied from another.
    It agrees with the statistics on each channel's messages and on the first and last time, and with the chunks on how
    many bytes there are."""
    entries, statistics = capture.metadata.get(TALLY), capture.statistics
    if entries is None or statistics is None:
        return None
    try:
        told = msgspec.json.decode(entries["keys"], type=dict[str, KeyTally])
    except (KeyError, msgspec.MsgspecError):
        return None
    names = tally_names(capture.channels)
    if told.keys() != set(names.values()):
        return None
    tallies = {id: told[name] for id, name in names.items()}
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
    """False statements of the file about itself, in words. MCAP readers do not look at them, so they are no damage."""
    if capture.problems:
        return []
    found = []
    if (
        capture.follows_conventions
        and TALLY in capture.metadata
        and capture.summarised
        and _told_tallies(capture) is None
    ):
        found.append(f"its metadata {TALLY!r} is not of this file, so its messages were counted")
    return found


def missing_of(capture: Capture) -> tuple[dict[str, int], dict[str, int]]:
    """By key, dropped and lost: what a whole file says at its end, else what the recorder said last on the mesh."""
    told = capture.metadata.get(TALLY)
    try:
        if told is not None:
            counts = dict[str, int]
            return msgspec.json.decode(told["dropped"], type=counts), msgspec.json.decode(told["lost"], type=counts)
        dropped: dict[str, int] = {}
        lost: dict[str, int] = {}
        for record in capture.messages(f"*/{RECORDING.name.partition('/')[2]}"):
            said = capture.decode(record)
            dropped, lost = said["dropped"], said["lost"]
        return dropped, lost
    except (KeyError, TypeError, msgspec.MsgspecError, DamageError):
        return {}, {}


def _key_report(
    capture: Capture, channel: int, tally: KeyTally, dropped: Mapping[str, int], lost: Mapping[str, int]
) -> KeyReport:
    span_s = (tally.last_ns - tally.first_ns) / NS
    schema = capture.schema(channel)
    key = capture.channels[channel].topic
    first = channel == capture.keys[key][0]  # what is missing is counted by key
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
        lost=lost.get(key, 0) if first else 0,
        dropped=dropped.get(key, 0) if first else 0,
        changed=tuple(changed_since(capture, channel)),
    )


def changed_since(capture: Capture, channel: int) -> list[str]:
    """Differences between the recorded schema of a channel and today's type of its key, in words."""
    schema, key = capture.schema(channel), capture.channels[channel].topic
    topic = topic_named(key.removeprefix(f"{capture.robot}/"))
    if schema is None or topic is None or capture.channels[channel].metadata.get("publisher") == MADE_HERE:
        return []
    if schema.name == LossyFrame.__name__:
        return []
    if todays_name(schema.name) != topic.type.__name__:
        return [f"it carries {topic.type.__name__} today"]
    if is_former(schema.name, schema.data):
        return [f"{schema.name} has changed: its former shape is converted"]
    kind: type[Message] = topic.type
    return [change.text for change in changes(schema.data, schema_of(kind).data)]


def _plain(value: str) -> Any:
    """Metadata that is JSON, as what it says."""
    if value[:1] in ("{", "["):
        try:
            return json.loads(value)
        except ValueError:
            pass
    return value
