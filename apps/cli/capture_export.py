"""`cocoro export`: a capture in the forms that people look at."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from apps.captures.export.files import refuse_existing
from apps.cli import exits
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.errors import ConfigError

EVERY_S = 0.5
"""Of the capture: how often progress is shown."""


def export(
    file: Path,
    video: Path | None = None,
    rrd: Path | None = None,
    foxglove: Path | None = None,
    csv: Path | None = None,
    parquet: Path | None = None,
    attachments: Path | None = None,
) -> int:
    """Raises CaptureError for what cannot be read or written, ConfigError when nothing is asked for."""
    if not any((video, rrd, foxglove, csv, parquet, attachments)):
        raise ConfigError("say what to make of it: --video, --foxglove, --csv, --parquet, --rrd or --attachments")
    for out in (video, rrd, foxglove):
        if out is not None:
            refuse_existing(out)  # now, not after the first of them has been made
    with Capture.open(file) as capture:
        if video is not None:
            from apps.captures.export import video as films

            pictures = films.export(capture, video, _progress(capture, video))
            _done(f"{video}: {pictures} pictures")
        if foxglove is not None:
            from apps.captures.export.foxglove import export as export_foxglove

            messages = export_foxglove(capture, foxglove, _progress(capture, foxglove))
            _done(f"{foxglove}: {messages} messages; open it with Foxglove")
        if csv is not None or parquet is not None:
            from apps.captures.export import tables

            if csv is not None:
                _done(f"{csv}: {len(tables.export(capture, tables.CsvFolder(csv)))} tables")
            if parquet is not None:
                _done(f"{parquet}: {len(tables.export(capture, tables.ParquetFolder(parquet)))} tables")
        if rrd is not None:
            from apps.captures.export import rerun_scene

            messages = rerun_scene.export(capture, rrd, _progress(capture, rrd))
            _done(f"{rrd}: {messages} messages; open it with `rerun {rrd}`")
        if attachments is not None:
            from apps.captures.export.files import export_attachments

            _done(f"{attachments}: {export_attachments(capture, attachments)} attachments")
        for problem in capture.problems:
            print(f"missing: {problem}", file=sys.stderr)
        if capture.ending:
            print(f"note: {file} was {capture.ending}", file=sys.stderr)
        return exits.FAILED if capture.problems else exits.DONE


def _progress(capture: Capture, out: Path) -> Callable[[float], None]:
    """A line that is written over, where somebody watches."""
    length_s, shown_s = (capture.end_ns - capture.start_ns) / NS, -EVERY_S

    def show(at_s: float) -> None:
        nonlocal shown_s
        if sys.stdout.isatty() and at_s - shown_s >= EVERY_S:
            shown_s = at_s
            print(f"\r\x1b[K{out}: {at_s:.1f} of {length_s:.1f} s", end="", flush=True)

    return show


def _done(text: str) -> None:
    print(f"\r\x1b[K{text}" if sys.stdout.isatty() else text)
