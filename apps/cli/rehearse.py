"""`cocoro rehearse`: runs a task in simulation and prints the result as text or JSON."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from apps.cli import exits
from apps.cli.options import frames_of, latencies_of, scene_of
from apps.cli.output import complain, print_json
from apps.cli.terminal import StatusLine
from apps.rehearsal.progress import Tell, ignored
from apps.rehearsal.request import RehearsalRequest
from cocoro.errors import CocoroError, ConfigError, field_text


def rehearse(
    options: dict[str, Any],
    latency: list[str],
    frames: str | None,
    as_json: bool,
    video: Path | None = None,
    camera: str = "outside",
) -> int:
    """Runs a rehearsal, makes a film of it when `video` is its file, and returns the exit code. `options` are fields of
    the request.

    Raises ConfigError for an impossible option, CaptureError for a film that cannot be made.
    """
    request = request_of(options, latency, frames)
    if video is None:
        return _run(request, as_json)
    from apps.captures.export import video as films  # imports much
    from apps.cli.export import film
    from cocoro.capture.reader import Capture

    films.camera_of(camera)
    films.check(video)
    with nullcontext(request.record) if request.record is not None else _capture_beside(video) as record:
        code = _run(msgspec.structs.replace(request, record=record), as_json)
        if Path(record).exists():
            with _output_to_stderr() if as_json else nullcontext(), Capture.open(Path(record)) as capture:
                print(f"{video}: {film(capture, video, camera)} pictures")
    return code


@contextmanager
def _capture_beside(video: Path) -> Iterator[str]:
    """A file for a capture that is there while the context lasts, on the disk that the film is for."""
    try:
        video.parent.mkdir(parents=True, exist_ok=True)
        folder = TemporaryDirectory(prefix=".film-", dir=video.parent)
    except OSError as error:
        raise CocoroError(f"{video.parent}: {error.strerror}; choose another place for the film") from error
    with folder as path:
        yield str(Path(path) / "rehearsal.mcap")


def _run(request: RehearsalRequest, as_json: bool) -> int:
    # A fork of a process with one thread starts sooner, and small matrices gain nothing by threads. NumPy reads it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from apps.rehearsal.ahead import begun_ahead

    request = msgspec.structs.replace(request, camera_process=True)
    try:
        with begun_ahead(), _output_to_stderr() if as_json else nullcontext(), StatusLine(sys.stderr) as line:
            from apps.rehearsal.rehearse import rehearse as run  # imports the simulator, which is slow

            tell: Tell = (lambda progress: line.show(str(progress))) if line.shown else ignored
            result: dict[str, Any] = run(request, tell)
    except CocoroError as error:
        refusal = getattr(error, "code", None)  # the executive refused the task
        if refusal is None:
            raise
        complain(f"refused: {error}")
        return exits.USAGE if refusal in exits.USAGE_REFUSALS else exits.REFUSED
    if as_json:
        print_json(result)
    else:
        print(summary(result))
    return exits.DONE if result["outcome"] == "done" else exits.FAILED


@contextmanager
def _output_to_stderr() -> Iterator[None]:
    """Redirects standard output, also of libraries in C, to standard error, so that JSON stands alone."""
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
        raise ConfigError(f"rehearse: {field_text(error, RehearsalRequest)}") from error


def summary(result: dict[str, Any]) -> str:
    """The result as text, one fact on each line."""
    name = f"{result['task']} {result['label']}".strip()
    reason = f": {result['reason']}" if result.get("reason") else ""
    speed = result["sim_s"] / result["wall_s"] if result["wall_s"] else 0.0
    lines = [f"{result['outcome']}: {name} in {result['sim_s']:.1f} s{reason}"]
    lines += [f"  {phase['name']:<10} {phase['sim_s']:6.1f} s" for phase in result["phases"]]
    lines.append(f"  took {result['wall_s']:.1f} s, {speed:.1f} times real time")
    if result.get("model"):
        lines.append(f"  reached with: {result['model']}")
    lines.append("in truth")
    lines += [f"  {name.replace('_', ' '):<18} {_value(value)}" for name, value in result["truth"].items()]
    earlier = result.get("tasks", [])[:-1]
    return "\n".join([*map(_in_short, earlier), *lines])


def _in_short(step: dict[str, Any]) -> str:
    """One line on a task before the last one."""
    name = f"{step['task']} {step['label']}".strip()
    touched = [*step["truth"].get("collisions", ()), *step["truth"].get("knocked_over", ())]
    return f"{step['outcome']}: {name} in {step['sim_s']:.1f} s" + (
        f"; touched {', '.join(touched)}" if touched else ""
    )


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3f}"
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "none"
    return str(value)
