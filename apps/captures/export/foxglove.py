"""`--foxglove`: an MCAP file that Foxglove opens as it is, by Foxglove's own schemas (foxglove-sdk, an extra).

Log times are the messages' stamps, so time is the robot's. Every recorded message is in the file as JSON as well, on a
topic named as its key, so that it can be plotted.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from apps.captures.export.files import making
from apps.captures.export.foxglove_scene import FoxgloveScene, for_json
from apps.captures.export.story import catalogue_of, robot_of
from apps.captures.rewrite import info_in
from cocoro.capture.mcap import DamageError
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import JSON, NotReadableError, TypeSchema
from cocoro.clock import NS
from cocoro.messages import Frame, Message
from services.capture.keys import KeyInfo, QueuedMessage
from services.capture.packing import Packer
from services.capture.writer import CaptureWriter, FileLimits

LATE_NS = 2 * NS
"""A message may be recorded this much later than others and is still sorted in by its stamp."""
PACK_LEVEL = 6
"""Of zstd; an export has more time than a recording."""


class FoxgloveMessage(NamedTuple):
    """One message of the new file."""

    topic: str
    message: Any
    """One of Foxglove's types, or plain data of a recorded message."""
    channel: int | None = None
    """The number of the recorded channel; None for Foxglove's types."""


def export(capture: Capture, out: Path, progress: Callable[[float], None] = lambda _: None) -> int:
    """Write the file. Returns the number of messages in it. Raises CaptureError when it cannot be written.

    `progress` is called with the seconds of the capture that are done.
    """
    with making(out):
        return _export(capture, out, progress)


def _export(capture: Capture, out: Path, progress: Callable[[float], None]) -> int:
    translator = Translator(capture)
    writer = CaptureWriter(lambda _: out, Packer("zstd", PACK_LEVEL), FileLimits(), lambda *_: KeyInfo(JSON, None, {}))
    newest_ns = 0
    for stamp_ns, made in _by_stamp(capture, translator, progress):
        newest_ns = max(newest_ns, stamp_ns)
        payload = msgspec.json.encode(made.message) if made.channel is not None else made.message.encode()
        info = translator.info_of(made)
        writer.put(QueuedMessage(made.topic, 0, newest_ns, newest_ns, payload, info, made.channel))
    writer.close()
    return writer.messages


def _by_stamp(
    capture: Capture, translator: Translator, progress: Callable[[float], None]
) -> Iterator[tuple[int, FoxgloveMessage]]:
    """Stamp and message, in the order of stamps for messages that are recorded less than LATE_NS late."""
    waiting: list[tuple[int, int, Record]] = []
    stamp_ns = _first_stamp_ns(capture)
    for number, record in enumerate(capture.messages()):
        if _stamped(record):
            stamp_ns = record.publish_ns
        heapq.heappush(waiting, (stamp_ns, number, record))
        while record.log_ns - waiting[0][2].log_ns > LATE_NS:
            at_ns, _, due = heapq.heappop(waiting)
            yield from ((at_ns, made) for made in translator.translate(due))
        progress((record.log_ns - capture.start_ns) / NS)
    while waiting:
        at_ns, _, due = heapq.heappop(waiting)
        yield from ((at_ns, made) for made in translator.translate(due))


def _first_stamp_ns(capture: Capture) -> int:
    return next((record.publish_ns for record in capture.messages() if _stamped(record)), 0)


def _stamped(record: Record) -> bool:
    """A message without a stamp was recorded with its log time as publish time; it is put beside its neighbour."""
    return record.publish_ns != record.log_ns


class Translator:
    """Makes Foxglove's messages of recorded ones."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._scene = FoxgloveScene(robot_of(capture), catalogue_of(capture))

    def translate(self, record: Record) -> Iterator[FoxgloveMessage]:
        try:
            message = self._capture.read(record)
        except NotReadableError:
            message = None
        if isinstance(message, Message):
            yield from (FoxgloveMessage(*shown) for shown in self._scene.of(message))
        if isinstance(message, Frame):
            return
        try:
            plain = self._capture.decode(record)
        except DamageError:
            return
        if isinstance(plain, dict):
            yield FoxgloveMessage(record.key, for_json(plain), record.channel)

    def info_of(self, made: FoxgloveMessage) -> KeyInfo:
        """A recorded channel keeps its schema; its payloads are JSON, with the length in place of bytes."""
        if made.channel is not None:
            return info_in(self._capture, made.channel)._replace(encoding=JSON, metadata={})
        schema = made.message.get_schema()
        return KeyInfo(schema.encoding, TypeSchema(schema.name, schema.encoding, schema.data), {})
