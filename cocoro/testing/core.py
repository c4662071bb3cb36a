"""A pure core, stepped by hand."""

from __future__ import annotations

from itertools import count
from typing import TypeVar

import msgspec

from cocoro.clock import NS
from cocoro.core import Core, Output, Sample
from cocoro.messages import Message
from cocoro.publisher import encode
from cocoro.topics import Topic

M = TypeVar("M", bound=Message)


class CoreUnderTest:
    """A pure core, stepped by hand. What is fed travels as on the wire: encoded and decoded."""

    def __init__(self, core: Core, now_ns: int = NS) -> None:
        self.core = core
        self.now_ns = now_ns
        self.steps: list[list[Output]] = []
        self._waiting: list[Sample] = []
        self._seqs: dict[str, count[int]] = {}

    def feed(self, topic: Topic[M], message: M, stamp_ns: int | None = None, incarnation: int = 1) -> M:
        """Have it consumed by the next step, if the core reads the topic; stamped with now by default. Returns what
        the core will get."""
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
        """One step, so much later; its outputs."""
        self.now_ns += round(after_s * NS)
        samples, self._waiting = self._waiting, []
        self.steps.append(list(self.core.step(samples, self.now_ns)))
        return self.steps[-1]

    def outputs(self, topic: Topic[M]) -> list[M]:
        """All that it gave on a topic, over all steps."""
        return [output.message for step in self.steps for output in step if output.topic.name == topic.name]  # type: ignore[misc]

    def latest(self, topic: Topic[M]) -> M:
        """What the last step gave on a topic; AssertionError when it gave nothing there."""
        found = [output.message for output in self.steps[-1] if output.topic.name == topic.name]
        assert found, f"the last step gave nothing on {topic.name}"
        return found[-1]  # type: ignore[return-value]
