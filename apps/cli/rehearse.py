"""`cocoro rehearse`: hand the request to the simulator, and say in words or in JSON what came of it."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from typing import Any

import msgspec

from apps.cli import exits
from apps.cli.options import frames_of, latencies_of
from apps.cli.running import scene_of
from apps.cli.tasks import USAGE_REFUSALS
from apps.rehearsal.request import RehearsalRequest
from cocoro.errors import CocoroError, ConfigError


def rehearse(options: dict[str, Any], latency: list[str], frames: str | None, as_json: bool) -> int:
    """`options` are fields of the request. Raises ConfigError for what cannot be."""
    request = request_of(options, latency, frames)
    from apps.rehearsal.rehearse import rehearse as run  # with the simulator, which takes its time to import

    try:
        with _output_to_stderr() if as_json else nullcontext():
            result: dict[str, Any] = run(request)
    except CocoroError as error:
        refusal = getattr(error, "code", None)  # of the executive, which would not start the task
        if refusal is None:
            raise
        print(f"cocoro: refused: {error}", file=sys.stderr)
        return exits.USAGE if refusal in USAGE_REFUSALS else exits.REFUSED
    print(json.dumps(result) if as_json else summary(result))
    return exits.DONE if result["outcome"] == "done" else exits.FAILED


@contextmanager
def _output_to_stderr() -> Iterator[None]:
    """Whatever is printed meanwhile, by libraries in C too, goes to stderr: JSON's place has nothing but JSON."""
    sys.stdout.flush()
    stdout_fd = os.dup(1)
    os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(stdout_fd, 1)
        os.close(stdout_fd)


def request_of(options: dict[str, Any], latency: list[str], frames: str | None) -> RehearsalRequest:
    """The request of the command's options. Raises ConfigError, which names the option that is wrong."""
    fields = {**options, "latency": latencies_of(latency), **(frames_of(frames) if frames else {})}
    fields["scene"] = scene_of(fields["scene"])
    try:
        return msgspec.convert(fields, RehearsalRequest)
    except msgspec.ValidationError as error:
        text, _, path = str(error).partition(" - at `$.")
        raise ConfigError(f"{path.rstrip('`') or 'rehearse'}: {text}") from error


def summary(result: dict[str, Any]) -> str:
    """The result in words, a fact a line."""
    name = f"{result['task']} {result['label']}".strip()
    reason = f": {result['reason']}" if result.get("reason") else ""
    speed = result["sim_s"] / result["wall_s"] if result["wall_s"] else 0.0
    lines = [f"{result['outcome']}: {name} in {result['sim_s']:.1f} s{reason}"]
    lines += [f"  {phase['name']:<10} {phase['sim_s']:6.1f} s" for phase in result["phases"]]
    lines.append(f"  took {result['wall_s']:.1f} s, {speed:.1f} times real time")
    if result.get("model"):
        lines.append(f"  reached with: {result['model']}")
    truth = result["truth"]
    lines.append("in truth")
    lines += [f"  {name.replace('_', ' '):<18} {_said(value)}" for name, value in truth.items()]
    return "\n".join(lines)


def _said(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3f}"
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "none"
    return str(value)
