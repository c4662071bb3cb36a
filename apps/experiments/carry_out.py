"""Performs one run of an experiment: a rehearsal or a lesson."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from apps.experiments import lessons
from apps.rehearsal.progress import Tell, ignored
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.errors import CocoroError

RunResult = dict[str, Any]
"""A run's result as JSON data; a failed run has its message under 'error'."""
LESSONS: dict[str, Callable[..., dict[str, Any]]] = {
    "learn": lessons.learn,
    "learn-rigid": lessons.rigid,
    "learn-wheels": lessons.wheels,
    "bend": lessons.bend,
}


def carry_out(kind: str, fields: dict[str, Any], tell: Tell = ignored) -> RunResult:
    """Performs one run; errors become part of the result. `tell` gets the progress of a rehearsal."""
    try:
        if kind == "rehearse":
            request = msgspec.convert(fields, RehearsalRequest)
            if request.samples is not None and request.bend_s is not None:
                # Samples of an interrupted run do not contain the bend at that time.
                Path(request.samples).unlink(missing_ok=True)
            return dict(rehearse(request, tell))
        return dict(LESSONS[kind](**fields))
    except (CocoroError, msgspec.ValidationError) as error:
        return {"error": str(error)}
    except Exception as error:  # a failed run must not end hundreds of others
        return {"error": f"{type(error).__name__}: {error}"}
