"""What every service says of itself: health, steps, exchanges, and what it was started with."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from cocoro.messages.common import Count, Finite, FiniteNonNegative, Message


class TopicHealth(msgspec.Struct, kw_only=True):
    key: str
    direction: Literal["in", "out"]
    count: Count = 0
    rate_hz: Finite = 0.0
    age_s: Finite | None = None
    """Of the newest sample by its stamp, when the health was taken; None when there was none."""
    skipped: Count = 0
    """State that was overwritten by newer state before it was read."""
    lost: Count = 0
    """Gaps in the sequence: never arrived."""
    rejected: Count = 0
    """Malformed, wrongly typed, oversized, out of order or untimely: counted, dropped."""
    last_error: str = ""
    """Why the last one was rejected."""
    fault: str = ""
    """Of a reader that has rejected messages of late: key, publisher, how many, why. For people."""
    unreadable: bool = False
    """Of a reader: for longer than one can wait, all that came was rejected."""


class LoopHealth(msgspec.Struct, kw_only=True):
    """Of a fixed-rate loop or a driven core, over the last health period."""

    name: str
    rate_hz: Finite = 0.0
    period_median_ms: Finite = 0.0
    period_p99_ms: Finite = 0.0
    step_median_ms: Finite = 0.0
    overruns: Count = 0
    """Periods that were missed altogether since the start."""


class Health(Message):
    service: str
    pid: int = 0
    state: Literal["starting", "ready", "degraded", "stopping"] = "starting"
    text: str = ""
    uptime_s: Finite = 0.0
    cpu_share: Finite = 0.0
    """Of one core, over the last health period."""
    rss_mb: Finite = 0.0
    topics: tuple[TopicHealth, ...] = ()
    loops: tuple[LoopHealth, ...] = ()
    faults: tuple[str, ...] = ()


class StepRecord(Message):
    """What one step of a pure core consumed and gave, in order: enough to execute it again exactly."""

    now_ns: int
    core: str = ""
    consumed: tuple[tuple[str, int, int], ...] = ()
    """(topic, incarnation, seq) in the order in which the core was given them."""
    produced: tuple[tuple[str, int, int], ...] = ()


class Exchange(Message):
    """A request that a service was asked, and what it answered: only the two of them see it otherwise."""

    request: str
    """Its name, e.g. 'executive/run'."""
    question: Any = None
    """As it was asked; None when it could not be understood."""
    answer: Any = None
    error: str = ""
    """In place of an answer."""
    took_ms: FiniteNonNegative = 0.0


class AboutRequest(msgspec.Struct, kw_only=True):
    pass


class AboutFile(msgspec.Struct, kw_only=True):
    """A file that a service's configuration names: a learned model, known objects."""

    field: str
    """The configuration's field, e.g. 'objects'."""
    path: str
    sha256: str
    """The file's fingerprint."""
    content: bytes = b""
    """Empty when the file is too large for a message."""


class AboutReply(msgspec.Struct, kw_only=True):
    """What a service is and what it was started with: all that its pure core can be made of again."""

    service: str
    robot: str
    module: str = ""
    """Python's name of the component; empty for what is none."""
    config: Any = None
    """The component's resolved Config, as a map."""
    description: Any = None
    """The robot description that it computes with, as a map."""
    latency_s: FiniteNonNegative = 0.0
    record_steps: bool = False
    pid: int = 0
    host: str = ""
    versions: dict[str, str] = {}
    files: tuple[AboutFile, ...] = ()
