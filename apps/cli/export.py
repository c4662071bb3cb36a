"""`cocoro export`: captures as film, table, scene of another viewer, or dataset to train with."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from apps.captures.export.files import refuse_existing
from apps.captures.info import left_out_notes
from apps.cli import exits
from apps.cli.options import CameraOption, CapturesArgument, JsonOption
from apps.cli.output import print_json
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.errors import ConfigError

NO_ATTACHMENTS = "recorders attach no files: the run's profile, description and model are in `cocoro capture info FILE`"

app = typer.Typer()


@app.command()
def export(
    files: CapturesArgument,
    video: Annotated[
        Path | None,
        typer.Option(
            "--video", metavar="OUT.mp4", help="Film of the camera's pictures with the detections; .webp: an animation."
        ),
    ] = None,
    camera: CameraOption = "robot",
    foxglove: Annotated[
        Path | None, typer.Option("--foxglove", metavar="OUT.mcap", help="For Foxglove; needs cocoro-mesh[foxglove].")
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="DIR", help="Tables, simulated truth beside belief.")
    ] = None,
    parquet: Annotated[
        Path | None, typer.Option("--parquet", metavar="DIR", help="The same tables; needs cocoro-mesh[tables].")
    ] = None,
    lerobot: Annotated[
        Path | None,
        typer.Option(
            "--lerobot",
            metavar="DIR",
            help="A LeRobotDataset, an episode for each task of all FILEs, or of those in folders; needs "
            "cocoro-mesh[lerobot].",
        ),
    ] = None,
    rate_hz: Annotated[
        int | None,
        typer.Option(
            "--fps", min=1, max=1000, metavar="HZ", help="Rate of the LeRobotDataset; by default the camera's."
        ),
    ] = None,
    rrd: Annotated[
        Path | None, typer.Option("--rrd", metavar="OUT.rrd", help="For Rerun; needs cocoro-mesh[view].")
    ] = None,
    attachments: Annotated[
        Path | None, typer.Option("--attachments", metavar="DIR", help="The files that are attached to the capture.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Turn a capture into a film, tables, a file for Foxglove or Rerun; captures into a LeRobotDataset. Its attachments
    can be extracted, too. Several forms at once are possible, but a dataset is made alone."""
    if lerobot is not None:
        if any((video, rrd, foxglove, csv, parquet, attachments)):
            raise ConfigError("--lerobot is a form of many captures; make the other forms by another command")
        sys.exit(export_dataset(files, lerobot, rate_hz, json))
    if rate_hz is not None:
        raise ConfigError("--fps is the rate of --lerobot DIR, which is missing")
    if len(files) > 1:
        raise ConfigError("several captures become one --lerobot DIR; of the other forms each is made of one capture")
    sys.exit(export_capture(files[0], video, rrd, foxglove, csv, parquet, attachments, camera, json))


def export_capture(
    file: Path,
    video: Path | None = None,
    rrd: Path | None = None,
    foxglove: Path | None = None,
    csv: Path | None = None,
    parquet: Path | None = None,
    attachments: Path | None = None,
    camera: str = "robot",
    as_json: bool = False,
) -> int:
    """Writes each form whose path is given, and returns the exit code.

    Raises CaptureError for a file that cannot be read or written, ConfigError when no form is asked for.
    """
    if not any((video, rrd, foxglove, csv, parquet, attachments)):
        raise ConfigError(
            "nothing to export: give at least one of --video, --foxglove, --csv, --parquet, --lerobot, --rrd, "
            "--attachments"
        )
    for out in (video, rrd, foxglove):
        if out is not None:
            refuse_existing(out)  # before the first form has taken minutes
    written: list[dict[str, object]] = []

    def wrote(path: Path, count: int, what: str, then: str = "") -> None:
        written.append({"path": str(path), what: count})
        if not as_json:
            print(f"{path}: {count} {what}{f'; {then}' if then else ''}")

    with Capture.open(file) as capture:
        if video is not None:
            wrote(video, film(capture, video, camera), "pictures")
        if foxglove is not None:
            from apps.captures.export.foxglove import export as export_foxglove

            with progress_bar(capture, foxglove) as show:
                messages = export_foxglove(capture, foxglove, show)
            wrote(foxglove, messages, "messages", "open it with Foxglove")
        if csv is not None or parquet is not None:
            from apps.captures.export import tables

            if csv is not None:
                wrote(csv, len(tables.export(capture, tables.CsvFolder(csv))), "tables")
            if parquet is not None:
                wrote(parquet, len(tables.export(capture, tables.ParquetFolder(parquet))), "tables")
        if rrd is not None:
            from apps.captures.export import rerun_scene

            with progress_bar(capture, rrd) as show:
                messages = rerun_scene.export(capture, rrd, show)
            wrote(rrd, messages, "messages", f"open it with `rerun {rrd}`")
        if attachments is not None:
            from apps.captures.export.files import export_attachments

            count = export_attachments(capture, attachments)
            wrote(attachments, count, "attachments", "" if count else NO_ATTACHMENTS)
        for problem in capture.problems:
            print(f"missing: {problem}", file=sys.stderr)
        if capture.ending:
            print(f"note: {file} was {capture.ending}", file=sys.stderr)
        for note in left_out_notes(capture):
            print(f"note: {note}", file=sys.stderr)
    if as_json:
        print_json({"written": written, "missing": [str(problem) for problem in capture.problems]})
    return exits.FAILED if capture.problems else exits.DONE


def export_dataset(files: Sequence[Path], out: Path, rate_hz: int | None = None, as_json: bool = False) -> int:
    """Makes one LeRobotDataset of captures, and returns the exit code. Raises CaptureError when none can be made."""
    from apps.captures.export import lerobot

    with _bar(out) as show:
        made = lerobot.export(files, out, rate_hz, lambda done, count: show(done / count))
    for problem in made.problems:
        print(f"missing: {problem}", file=sys.stderr)
    for what in made.left_out:
        print(f"left out: {what}", file=sys.stderr)
    if as_json:
        written = {"path": str(out), "episodes": made.episodes, "succeeded": made.succeeded, "rows": made.rows}
        print_json({"written": [written], "missing": made.problems, "left_out": made.left_out})
    else:
        print(f"{out}: {made.episodes} episodes ({made.succeeded} succeeded), {made.rows} rows, {made.seconds:.1f} s")
    return exits.FAILED if made.problems else exits.DONE


def film(capture: Capture, out: Path, camera: str) -> int:
    """Makes a film of a capture, and returns the number of its pictures.

    Raises CaptureError when it cannot be made, ConfigError for an unknown camera.
    """
    from apps.captures.export import video

    with progress_bar(capture, out) as show:
        return video.export(capture, out, show, video.camera_of(camera))


@contextmanager
def progress_bar(capture: Capture, out: Path) -> Iterator[Callable[[float], None]]:
    """Yields a function that moves a bar to a position, s from the capture's start; shows none without a terminal."""
    with _bar(out, (capture.end_ns - capture.start_ns) / NS) as show:
        yield show


@contextmanager
def _bar(out: Path, whole: float = 1.0) -> Iterator[Callable[[float], None]]:
    if not sys.stdout.isatty():
        yield lambda _at: None
        return
    from rich.markup import escape
    from rich.progress import Progress

    with Progress(transient=True, redirect_stdout=False, redirect_stderr=False) as progress:
        bar = progress.add_task(escape(str(out)), total=whole)
        yield lambda at: progress.update(bar, completed=at)
