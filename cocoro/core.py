"""The contract of a service's pure core: no I/O, no clock, no randomness of its own.

The node gathers what arrived since the last step, calls `step`, and publishes what it returns; it can record
for each step its `now` and what was consumed, which is all that exact re-execution needs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

from cocoro.messages import Message
from cocoro.topics import Topic

Take = Literal["latest", "all"]
"""`latest`: of what arrived since the last step only the newest. `all`: everything, in order (bounded)."""


class Sample(NamedTuple):
    topic: Topic[Any]
    message: Message


class Output(NamedTuple):
    topic: Topic[Any]
    message: Message
    """`stamp_ns` 0 lets the node stamp it with the step's now."""


@dataclass(frozen=True)
class Schedule:
    """When a core is stepped: at a fixed rate, when a triggering topic arrives, or both."""

    rate_hz: float | None
    triggers: tuple[Topic[Any], ...] = ()


class Core(Protocol):
    """A service's maths."""

    @property
    def reads(self) -> Mapping[Topic[Any], Take]:
        """The topics that it consumes."""

    @property
    def schedule(self) -> Schedule: ...

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        """One step. Same inputs and nows in the same order give the same outputs, always."""
