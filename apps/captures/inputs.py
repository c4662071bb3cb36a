"""A service's steps as they were recorded: what each consumed and gave, found in a capture in one pass."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import msgspec

from cocoro.capture.errors import CaptureError
from cocoro.capture.pictures import LossyFrame
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import NotReadableError
from cocoro.clock import NS
from cocoro.messages import StepRecord
from cocoro.topics import STEPS

Id = tuple[str, int, int]
"""Topic, incarnation, sequence: what a StepRecord calls a message by."""

LATE_NS = 3 * NS
"""A message that is recorded so long after the step that speaks of it is not waited for."""


class Head(msgspec.Struct, gc=False):
    seq: int = 0
    incarnation: int = 0


class Found(NamedTuple):
    """A message of a step, with the capture that it is in."""

    capture: Capture
    record: Record


class Step(NamedTuple):
    record: StepRecord
    log_ns: int
    messages: dict[Id, Found]
    """What the captures have of those that were consumed and produced."""


def steps_of(captures: Sequence[Capture], service: str) -> list[tuple[int, StepRecord]]:
    """Log time and content of every record of a step. Raises CaptureError when there is none, or one cannot be read."""
    found = []
    for capture in captures:
        for record in capture.messages(f"{capture.robot}/{STEPS.of(service).name}"):
            try:
                step = capture.read(record)
            except NotReadableError as error:
                raise CaptureError(f"{capture.path}: {error}") from error
            assert isinstance(step, StepRecord)
            found.append((record.log_ns, step))
    if not found:
        raise CaptureError(
            f"{captures[0].path}: it has no steps of {service}; have them recorded by record_steps = true "
            f"in the profile's [service.{service}]"
        )
    return found


def with_messages(captures: Sequence[Capture], steps: Sequence[tuple[int, StepRecord]]) -> Iterator[Step]:
    """The steps in order, each as soon as all is there that it speaks of, or as soon as that will not come any more."""
    wanted: set[Id] = set()
    for _, step in steps:
        wanted.update(step.consumed, step.produced)
    topics = {topic for topic, _, _ in wanted}
    waiting = deque(steps)
    known: dict[Id, Found] = {}
    for capture in captures:
        decoder = msgspec.msgpack.Decoder(Head)
        for record in capture.messages(*(f"{capture.robot}/{topic}" for topic in topics)) if topics else ():
            head = _head(decoder, record)
            if head is None:
                continue
            name = (record.key.removeprefix(f"{capture.robot}/"), head.incarnation, head.seq)
            if name in wanted and not _lossy(capture, record):
                known[name] = Found(capture, record)
            while waiting and (_complete(waiting[0][1], known) or record.log_ns > waiting[0][0] + LATE_NS):
                yield _taken(waiting.popleft(), known, wanted)
    while waiting:
        yield _taken(waiting.popleft(), known, wanted)


def _head(decoder: msgspec.msgpack.Decoder[Head], record: Record) -> Head | None:
    try:
        return decoder.decode(record.payload)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def _complete(step: StepRecord, known: dict[Id, Found]) -> bool:
    return all(name in known for name in step.consumed) and all(name in known for name in step.produced)


def _taken(step: tuple[int, StepRecord], known: dict[Id, Found], wanted: set[Id]) -> Step:
    """Each message belongs to one step, so it need not be kept any more; nor is it when it comes late."""
    log_ns, record = step
    names = (*record.consumed, *record.produced)
    wanted.difference_update(names)
    messages = {name: known.pop(name) for name in names if name in known}
    return Step(record, log_ns, messages)


def _lossy(capture: Capture, record: Record) -> bool:
    """A frame that was kept with loss is not what the step was given."""
    schema = capture.schema(record.channel)
    return schema is not None and schema.name == LossyFrame.__name__
