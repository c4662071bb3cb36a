"""Messages of every service: health, step records, request records, and its configuration."""

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
    """Age of the newest message by its stamp at the time of this report; None without a message."""
    skipped: Count = 0
    """Messages that a newer one replaced because the reader was too slow for them. One that a newer one replaced for a
    reader that looks at its own times is not counted."""
    lost: Count = 0
    """Messages missing from the sequence."""
    rejected: Count = 0
    """Messages that were dropped as malformed, of a wrong type, oversized, out of order or untimely."""
    expired: Count = 0
    """Of the rejected: commands that were good but older than a command may be, because somebody was late."""
    last_error: str = ""
    """The reason of the last rejection."""
    fault: str = ""
    """Recent rejections of a reader, for people: key, publisher, count, reason."""
    unreadable: bool = False
    """True when a reader has rejected every message for longer than it can wait."""


class LoopHealth(msgspec.Struct, kw_only=True):
    """Timing of a fixed-rate loop or of a driven core over the last health period."""

    name: str
    rate_hz: Finite = 0.0
    period_median_ms: Finite = 0.0
    period_p99_ms: Finite = 0.0
    step_median_ms: Finite = 0.0
    overruns: Count = 0
    """Number of periods without a step since the start."""


class Health(Message):
    service: str
    pid: int = 0
    state: Literal["starting", "ready", "degraded", "stopping"] = "starting"
    text: str = ""
    uptime_s: Finite = 0.0
    cpu_share: Finite = 0.0
    """CPU time over the last health period, as a share of one core."""
    rss_mb: Finite = 0.0
    topics: tuple[TopicHealth, ...] = ()
    loops: tuple[LoopHealth, ...] = ()
    faults: tuple[str, ...] = ()


class StepRecord(Message):
    """Inputs and outputs of one step of a pure core, in order. With it the step can be re-executed exactly."""

    now_ns: int
    core: str = ""
    consumed: tuple[tuple[str, int, int], ...] = ()
    """(topic, incarnation, seq) of each input, in the order in which the core received them."""
    produced: tuple[tuple[str, int, int], ...] = ()


class Exchange(Message):
    """The record of a request and its answer, which otherwise only caller and server see."""

    request: str
    """Name of the request, e.g. 'executive/run'."""
    question: Any = None
    """The decoded question; None when it could not be decoded."""
    answer: Any = None
    error: str = ""
    """Text of the error that the caller received in place of an answer."""
    took_ms: FiniteNonNegative = 0.0


class TimeRequest(msgspec.Struct, kw_only=True):
    pass


class TimeReply(msgspec.Struct, kw_only=True):
    """The robot's time on the answering host, when the question arrived and when the answer left."""

    received_ns: int
    answered_ns: int


class ClockOffset(Message):
    """A host's clock compared with that of the host that keeps its robot's time."""

    host: str
    keeper: str
    """The host that keeps the time; this one itself where it does."""
    state: Literal["keeps", "waits", "follows", "refused", "shown"]
    """`waits`: not compared yet; `follows`: corrected; `refused`: too uncertain or too far off, so what this host says
    is not passed on; `shown`: the robot's time is the simulator's, and nothing is corrected."""
    ahead_s: Finite | None = None
    """This host's time minus the keeper's; None before the first answer."""
    uncertainty_s: Finite | None = None
    """The true difference is within this of `ahead_s`."""
    gains_ppm: Finite | None = None
    """How much faster this machine's steady clock runs than the keeper's time; None before it was observed for long
    enough."""
    round_trip_s: Finite | None = None
    """Of the exchange that the comparison rests on."""
    unanswered: Count = 0
    """Questions without an answer."""


class AboutRequest(msgspec.Struct, kw_only=True):
    pass


class AboutFile(msgspec.Struct, kw_only=True):
    """A file that a service's configuration names, such as a learned model."""

    field: str
    """The field of the configuration that names it, e.g. 'objects'."""
    path: str
    sha256: str
    """SHA-256 of the file, hexadecimal."""
    content: bytes = b""
    """Empty when the file is too large for a message."""


class AboutReply(msgspec.Struct, kw_only=True):
    """Identity and configuration of a service: everything from which its pure core can be constructed again."""

    service: str
    robot: str
    module: str = ""
    """Python module of the component's implementation; empty for a participant that is no component."""
    config: Any = None
    """The component's resolved configuration, as a map."""
    description: Any = None
    """The robot description that the service uses, as a map."""
    latency_s: FiniteNonNegative = 0.0
    record_steps: bool = False
    pid: int = 0
    host: str = ""
    versions: dict[str, str] = {}
    files: tuple[AboutFile, ...] = ()
