"""What a capture has: its keys with their counts, rates, gaps and losses, and where it came from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import msgspec

from cocoro.capture.errors import DamageError
from cocoro.capture.file import KeyTally
from cocoro.capture.keys import MADE_HERE
from cocoro.capture.pictures import LossyFrame
from cocoro.capture.reader import Capture
from cocoro.capture.schema import changes, schema_of
from cocoro.capture.writer import TALLY
from cocoro.clock import NS
from cocoro.messages import Message
from cocoro.topics import RECORDING, topic_named


class KeyReport(msgspec.Struct, kw_only=True):
    key: str
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


class Report(msgspec.Struct, kw_only=True):
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
    metadata: dict[str, dict[str, Any]]


def report(capture: Capture, check: bool = False) -> Report:
    """Of a whole capture by what it says of itself (its checksums vouch for that), unless `check` asks to read it
    all; of any other by reading it all."""
    tallies = None if check or not capture.whole else _told_tallies(capture)
    checked = tallies is None
    if tallies is None:
        tallies = _counted(capture)
    dropped, lost = missing_of(capture)
    keys = tuple(_key_report(capture, key, tallies[key], dropped, lost) for key in sorted(tallies))
    return Report(
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
        metadata={
            name: {entry: _plain(value) for entry, value in entries.items()}
            for name, entries in capture.metadata.items()
            if name != TALLY
        },
    )


def _told_tallies(capture: Capture) -> dict[str, KeyTally] | None:
    told = capture.metadata.get(TALLY)
    if told is None:
        return None
    try:
        return msgspec.json.decode(told["keys"], type=dict[str, KeyTally])
    except (KeyError, msgspec.MsgspecError):
        return None


def _counted(capture: Capture) -> dict[str, KeyTally]:
    tallies = {key: KeyTally() for key in capture.keys}
    for record in capture.messages():
        tallies[record.key].add(record.log_ns, len(record.payload))
    return tallies


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
    capture: Capture, key: str, tally: KeyTally, dropped: Mapping[str, int], lost: Mapping[str, int]
) -> KeyReport:
    span_s = (tally.last_ns - tally.first_ns) / NS
    schema = capture.schema(key)
    return KeyReport(
        key=key,
        type="" if schema is None else schema.name,
        messages=tally.messages,
        rate_hz=(tally.messages - 1) / span_s if span_s > 0 else 0.0,
        size_bytes=tally.size_bytes,
        longest_gap_s=tally.longest_gap_ns / NS,
        longest_gap_from_s=max(tally.longest_gap_from_ns - capture.start_ns, 0) / NS,
        lost=lost.get(key, 0),
        dropped=dropped.get(key, 0),
        changed=tuple(changed_since(capture, key)),
    )


def changed_since(capture: Capture, key: str) -> list[str]:
    """What is different in today's type of a key, in words."""
    schema = capture.schema(key)
    topic = topic_named(key.removeprefix(f"{capture.robot}/"))
    if schema is None or topic is None or capture.keys[key].metadata.get("publisher") == MADE_HERE:
        return []
    if schema.name == LossyFrame.__name__:
        return []
    if schema.name != topic.type.__name__:
        return [f"it carries {topic.type.__name__} today"]
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
