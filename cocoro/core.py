"""The contract of a pure core: no I/O, no clock, no source of randomness besides its inputs.

The node collects the messages that arrive between two steps, calls `step` and publishes the outputs. It can record the
time and the inputs of each step; exact re-execution needs nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

from cocoro.messages import Message
from cocoro.topics import Topic

Take = Literal["latest", "all"]
"""Which messages of a topic a step gets: the newest since the last step, or all of them in order (bounded)."""


class Sample(NamedTuple):
    """One input of a step."""

    topic: Topic[Any]
    message: Message


class Output(NamedTuple):
    """One output of a step."""

    topic: Topic[Any]
    message: Message
    """With `stamp_ns` 0 the node stamps it with the time of the step."""


@dataclass(frozen=True)
class Schedule:
    """The times at which a core is stepped: at a fixed rate, when a message of a triggering topic arrives, or both.

    With both, a message that arrives between two steps brings the next one forward, and the following one comes a
    period after that. So a step comes at most a period after the one before.
    """

    rate_hz: float | None
    triggers: tuple[Topic[Any], ...] = ()


class Core(Protocol):
    """The computation of a service, as a function of its inputs and its state."""

    @property
    def reads(self) -> Mapping[Topic[Any], Take]:
        """The topics of its inputs."""

    @property
    def schedule(self) -> Schedule: ...

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        """One step at the robot's time `now_ns`. Equal sequences of inputs and times give equal outputs."""
