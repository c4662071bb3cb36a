"""Pure cores: stepped by hand, and re-executed over their records."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import count
from typing import NamedTuple, TypeVar

import msgspec

from cocoro.clock import NS
from cocoro.core import Core, Output, Sample
from cocoro.errors import CocoroError
from cocoro.messages import Message, StepRecord
from cocoro.publisher import encode
from cocoro.topics import Topic

M = TypeVar("M", bound=Message)


class CoreUnderTest:
    """A pure core, stepped by hand. Its inputs are encoded and decoded, as on the wire."""

    def __init__(self, core: Core, now_ns: int = NS) -> None:
        self.core = core
        self.now_ns = now_ns
        self.steps: list[list[Output]] = []
        self._waiting: list[Sample] = []
        self._seqs: dict[str, count[int]] = {}

    def feed(self, topic: Topic[M], message: M, stamp_ns: int | None = None, incarnation: int = 1) -> M:
        """Give a message to the next step, if the core reads the topic; stamped with now by default. Returns the
        message as the core will get it."""
        if stamp_ns is not None:
            message.stamp_ns = stamp_ns
        elif message.stamp_ns == 0:
            message.stamp_ns = self.now_ns
        message.incarnation = incarnation
        message.seq = next(self._seqs.setdefault(topic.name, count()))
        received = msgspec.msgpack.decode(encode(message), type=topic.type)
        takes = {read.name: take for read, take in self.core.reads.items()}
        take = takes.get(topic.name)
        if take == "latest":
            self._waiting = [sample for sample in self._waiting if sample.topic.name != topic.name]
        if take is not None:
            self._waiting.append(Sample(topic, received))
        return received

    def step(self, after_s: float = 0.0) -> list[Output]:
        """One step, `after_s` later; returns its outputs."""
        self.now_ns += round(after_s * NS)
        samples, self._waiting = self._waiting, []
        self.steps.append(list(self.core.step(samples, self.now_ns)))
        return self.steps[-1]

    def outputs(self, topic: Topic[M]) -> list[M]:
        """All outputs on a topic, of all steps."""
        return [output.message for step in self.steps for output in step if output.topic.name == topic.name]  # type: ignore[misc]

    def latest(self, topic: Topic[M]) -> M:
        """The newest output of the last step on a topic. Raises AssertionError when there is none."""
        found = [output.message for output in self.steps[-1] if output.topic.name == topic.name]
        assert found, f"the last step has no output on {topic.name}"
        return found[-1]  # type: ignore[return-value]


class Executed(NamedTuple):
    """One output of a re-executed step, and the recorded one; both encoded as on the wire."""

    topic: str
    again: bytes
    recorded: bytes


def execute_again(
    core: Core, records: Iterable[StepRecord], samples: Mapping[tuple[str, int, int], Message]
) -> list[Executed]:
    """Execute a fresh core over the inputs of recorded steps; `samples` are all recorded messages by topic, incarnation
    and sequence number. The caller compares the outputs. Raises CocoroError when a recorded message is missing, or when
    a step has outputs on other topics than the recorded step."""
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
            # The node fills these in, not the core.
            message.stamp_ns = message.stamp_ns or then.stamp_ns
            message.incarnation, message.seq = then.incarnation, then.seq
            executed.append(Executed(key[0], encode(message), encode(then)))
    return executed
