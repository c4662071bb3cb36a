"""`cocoro capture repair`: a whole capture from one that is not."""

from __future__ import annotations

from pathlib import Path

from apps.captures.rewrite import rewrite
from apps.cli import exits
from apps.cli.capture_span import check_span
from cocoro.capture.compression import COMPRESSIONS, Compression, Packer
from cocoro.capture.keys import Choice
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.errors import ConfigError


def repair(
    file: Path,
    out: Path | None,
    compression: str,
    level: int,
    only: list[str],
    without: list[str],
    start_s: float | None,
    end_s: float | None,
) -> int:
    """Raises CaptureError, and ConfigError for options that cannot be."""
    packer = Packer(_compression(compression), level)
    with Capture.open(file) as capture:
        choice = Choice(capture.robot, only, without)
        check_span(capture, start_s, end_s)
        done = rewrite(
            capture,
            out or file.with_suffix(".repaired.mcap"),
            packer,
            keep=(lambda record: record.key in choice) if only or without else None,
            start_ns=_at(capture, start_s),
            end_ns=_at(capture, end_s),
        )
    attachments = f", {done.attachments} attachments" if done.attachments else ""
    print(f"{done.path}: {done.messages} messages{attachments}, {done.size_bytes / 1e6:.1f} MB")
    for problem in done.problems:
        print(f"missing: {problem}")
    for note in done.notes:
        print(f"left out: {note}")
    if capture.ending:
        print(f"note: {file} was {capture.ending}")
    return exits.DONE


def _at(capture: Capture, seconds: float | None) -> int | None:
    return None if seconds is None else capture.start_ns + round(seconds * NS)


def _compression(text: str) -> Compression:
    for known in COMPRESSIONS:
        if text == known:
            return known
    raise ConfigError(f"--compression {text}: known are {', '.join(COMPRESSIONS)}")
