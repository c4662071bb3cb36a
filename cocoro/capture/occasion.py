"""What happened in a capture: the recorder writes it into the file's metadata, readers show it in lists."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import msgspec

OCCASION = "occasion"
"""Metadata record of a capture with an occasion: what happened, its task and outcome, and notes with their times."""


class Note(msgspec.Struct, frozen=True):
    log_ns: int
    text: str


class Occasion(msgspec.Struct, kw_only=True):
    """Something that happens, in the words of a file's metadata."""

    kind: str
    """task, stop, fault or motion."""
    what: str
    """In words: the task with its target, or the fault."""
    label: str
    """In the file's name."""
    began_ns: int
    """Log time."""
    ended_ns: int | None = None
    task_id: str = ""
    outcome: str = ""
    """done, failed, cancelled; '' while the task runs, for other occasions, and when nobody told it."""
    reason: str = ""
    elapsed_s: float = 0.0
    notes: tuple[Note, ...] = ()
    """Faults, stops and motion during the occasion, its cause first."""

    def entries(self) -> dict[str, str]:
        """Encode the fields as metadata: text as it is, everything else as JSON."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return {name: value if isinstance(value, str) else json.dumps(value) for name, value in plain.items()}


def occasion_of(entries: Mapping[str, str]) -> Occasion | None:
    """Read back from metadata; None when they are another program's."""
    try:
        fields = msgspec.json.decode(
            "{" + ",".join(f"{json.dumps(name)}:{_json(name, value)}" for name, value in entries.items()) + "}"
        )
        return msgspec.convert(fields, Occasion)
    except (msgspec.MsgspecError, ValueError):
        return None


def _json(name: str, value: str) -> str:
    return value if name in ("began_ns", "ended_ns", "elapsed_s", "notes") else json.dumps(value)
