"""The commands about captures and their options; `app` takes them in."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated

import typer

from apps.cli.options import (
    CaptureArgument,
    FromOption,
    JsonOption,
    MeshOption,
    OnlyOption,
    RobotChoice,
    RobotOption,
    ToOption,
    WithoutOption,
)

PANEL = "Captures"

capture = typer.Typer(no_args_is_help=True, help="Look at, mend and execute captures.")


def add_to(app: typer.Typer) -> None:
    app.add_typer(capture, name="capture", rich_help_panel=PANEL)
    app.command(rich_help_panel=PANEL)(record)
    app.command(rich_help_panel=PANEL)(replay)
    app.command(rich_help_panel=PANEL)(export)
    app.command(rich_help_panel=PANEL)(view)


def record(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the files go.")] = Path(),
    only: OnlyOption = None,
    without: WithoutOption = None,
    compression: Annotated[str, typer.Option(metavar="zstd|lz4|none", help="Without loss.")] = "zstd",
    jpeg: Annotated[
        int | None, typer.Option(min=1, max=100, metavar="QUALITY", help="The pictures with loss, far smaller.")
    ] = None,
    seconds: Annotated[float | None, typer.Option("--for", min=0.1, metavar="S", help="Stop by itself.")] = None,
    robot: RobotOption = None,
    profile: MeshOption = None,
) -> None:
    """Record what travels on the mesh into MCAP files, until Ctrl-C, beside what the robot's own recorder does."""
    from apps.cli import capture_mesh

    settings = {
        "folder": str(out.resolve()), "only": only or (), "without": without or (),
        "compression": compression, "jpeg_quality": jpeg,
    }  # fmt: skip
    sys.exit(asyncio.run(capture_mesh.record(RobotChoice(robot, profile), settings, seconds)))


def replay(
    file: CaptureArgument,
    rate: Annotated[float, typer.Option(min=0.01, max=100.0, help="How many times as fast.")] = 1.0,
    start: FromOption = None,
    end: ToOption = None,
    loop: Annotated[bool, typer.Option("--loop", help="Again and again.")] = False,
    only: OnlyOption = None,
    paused: Annotated[bool, typer.Option("--paused", help="Begin with a pause; needs a terminal.")] = False,
    hardware: Annotated[
        bool, typer.Option("--hardware", help="Only what the robot's hardware said: be the robot.")
    ] = False,
) -> None:
    """Send a capture into the mesh again. With --hardware, `cocoro up replay` in another terminal works on it.

    Keys: space pauses, . goes to the next picture, left and right 5 s, + and - change the rate, q ends.
    """
    from apps.cli import capture_mesh

    options = {"start_s": 0.0 if start is None else start, "end_s": end, "rate": rate, "loop": loop, "paused": paused}
    sys.exit(asyncio.run(capture_mesh.replay(file, only or [], hardware, options)))


def export(
    file: CaptureArgument,
    video: Annotated[
        Path | None, typer.Option("--video", metavar="OUT.mp4", help="What the robot saw, detections drawn in.")
    ] = None,
    foxglove: Annotated[Path | None, typer.Option("--foxglove", metavar="OUT.mcap", help="For Foxglove.")] = None,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="DIR", help="Tables, truth beside belief.")] = None,
    parquet: Annotated[
        Path | None, typer.Option("--parquet", metavar="DIR", help="The same; needs cocoro-mesh[tables].")
    ] = None,
    rrd: Annotated[
        Path | None, typer.Option("--rrd", metavar="OUT.rrd", help="For Rerun; needs cocoro-mesh[view].")
    ] = None,
    attachments: Annotated[
        Path | None, typer.Option("--attachments", metavar="DIR", help="The files that are attached to it.")
    ] = None,
) -> None:
    """Turn a capture into a film, tables, or a file for Foxglove or Rerun; or get out what is attached to it. Several
    at once, if wanted."""
    from apps.cli import capture_export

    sys.exit(capture_export.export(file, video, rrd, foxglove, csv, parquet, attachments))


def view(
    file: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="A capture; without one, the mesh.")] = None,
    robot: RobotOption = None,
    profile: MeshOption = None,
) -> None:
    """Open Rerun on a capture, or live on the mesh. Needs the extra `view`."""
    from apps.cli import capture_mesh

    if file is not None:
        sys.exit(capture_mesh.view_file(file))
    sys.exit(asyncio.run(capture_mesh.view_mesh(RobotChoice(robot, profile))))


@capture.command()
def info(
    file: CaptureArgument,
    check: Annotated[bool, typer.Option("--check", help="Read every byte, instead of believing the summary.")] = False,
    json: JsonOption = False,
) -> None:
    """What a capture has: keys, counts, rates, gaps, losses and where it is from. Exit code 1 when it is damaged."""
    from apps.cli import capture_files

    sys.exit(capture_files.info(file, check, json))


@capture.command()
def repair(
    file: CaptureArgument,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="By default FILE.repaired.mcap.")] = None,
    compression: Annotated[str, typer.Option(metavar="zstd|lz4|none", help="Of the new file.")] = "zstd",
    level: Annotated[int, typer.Option(min=1, max=19, help="Of zstd; 19 is small and slow.")] = 1,
    only: OnlyOption = None,
    without: WithoutOption = None,
    start: FromOption = None,
    end: ToOption = None,
) -> None:
    """Write a whole capture with all that can be read of a damaged or unfinished one; the old file stays."""
    from apps.cli import capture_files

    sys.exit(capture_files.repair(file, out, compression, level, only or [], without or [], start, end))


@capture.command("rerun", hidden=True)
@capture.command()
def reexecute(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="The captures of one run, in order.")],
    service: Annotated[str, typer.Option("--service", help="perception, planning, or another with a pure core.")],
    against: Annotated[
        str, typer.Option(metavar="recorded|nothing", help="What to compare the outputs with.")
    ] = "recorded",
    tolerance: Annotated[
        float, typer.Option(min=0.0, max=0.1, help="Of numbers, relative to the largest of 1 and them; 0 is exact.")
    ] = 0.0,
    json: JsonOption = False,
) -> None:
    """Execute a service again over what it was given then, and compare what it gives. Exit code 1 when it differs."""
    from apps.cli import capture_files

    sys.exit(capture_files.reexecute(files, service, against, tolerance, json))
