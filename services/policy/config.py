"""The settings of the policy service: the `[service.policy]` table of a profile."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro.units import Positive


class PolicyServiceConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    policies: dict[str, str] = {}  # a msgspec struct copies its defaults
    """By the name that a task gives: an ONNX file, `module:callable`, or `file.py:callable`."""
    folder: str = ""
    """Every NAME.onnx in it is a policy, too; empty: no folder."""
    anything: bool = False
    """A task may also name a file or callable itself. It runs as a part of this service: only for rehearsals, and
    machines whose operators may run any program."""
    threads: Annotated[int, Meta(ge=1, le=64)] = 2
    """Threads of ONNX inference."""
    providers: tuple[str, ...] = ("CPUExecutionProvider",)
    """ONNX Runtime's execution providers, the preferred first."""
    state_wait_s: Positive = 0.05
    """Longest wait of an observation, after its picture, for the states of that time."""
    virtual_s: Annotated[float, Meta(ge=0)] = 0.02
    """Time that a policy takes to act in virtual time, where its own time does not count."""
