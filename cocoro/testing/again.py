"""Exact re-execution: a core over what it was recorded to have consumed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from cocoro.core import Core, Sample
from cocoro.errors import CocoroError
from cocoro.messages import Message, StepRecord
from cocoro.publisher import encode


class Executed(NamedTuple):
    """One output of a step that was executed again, beside what was published then; both as they travel."""

    topic: str
    again: bytes
    recorded: bytes


def execute_again(
    core: Core, records: Iterable[StepRecord], samples: Mapping[tuple[str, int, int], Message]
) -> list[Executed]:
    """Execute a fresh core over what a recorded one consumed. Raises CocoroError when a message that it consumed is
    not there, or when it gives more or fewer outputs than it did; whether these are equal is for the caller to say."""
    topics = {topic.name: topic for topic in core.reads}
    executed = []
    for record in records:
        missing = [key for key in (*record.consumed, *record.produced) if key not in samples]
        if missing:
            raise CocoroError(f"the step at {record.now_ns} ns consumed or gave {missing[0]}, which was not recorded")
        consumed = [Sample(topics[key[0]], samples[key]) for key in record.consumed]
        outputs = core.step(consumed, record.now_ns)
        if [output.topic.name for output in outputs] != [key[0] for key in record.produced]:
            raise CocoroError(f"the step at {record.now_ns} ns gave other topics than it did when it was recorded")
        for (_, message), key in zip(outputs, record.produced, strict=True):
            then = samples[key]
            # What the node fills in is no work of the core's.
            message.stamp_ns = message.stamp_ns or then.stamp_ns
            message.incarnation, message.seq = then.incarnation, then.seq
            executed.append(Executed(key[0], encode(message), encode(then)))
    return executed
