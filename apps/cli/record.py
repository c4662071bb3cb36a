"""`cocoro record`: the recorder in the operator's terminal, besides the robot's own."""

from __future__ import annotations

import asyncio
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from apps.cli import exits
from apps.cli.interrupt import interrupt_event
from apps.cli.link import joined
from apps.cli.options import JsonOption, OnlyOption, RobotChoice, RobotOption, ThroughOption, WithoutOption, name_option
from apps.cli.output import complain, going_on, tell
from apps.cli.terminal import StatusLine
from cocoro.clock import FollowedClock
from cocoro.component import load as load_component
from cocoro.errors import ConfigError, field_text
from cocoro.installed import unrecorded
from cocoro.messages import Recording
from cocoro.node import Node
from cocoro.topics import RECORDING
from services.capture.component import CAPTURE
from services.capture.writer import describe_disturbance

END_S = 1.0
"""Longest wait for the recorder's last message after it has ended."""

app = typer.Typer()


@app.command()
def record(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the files go.")] = Path(),
    only: OnlyOption = None,
    without: WithoutOption = None,
    compression: Annotated[
        str,
        name_option("zstd", "lz4", "none", help="Lossless compression."),
    ] = "zstd",
    jpeg: Annotated[
        int | None,
        typer.Option(min=1, max=100, metavar="QUALITY", help="Store pictures as JPEG: lossy and far smaller."),
    ] = None,
    seconds: Annotated[float | None, typer.Option("--for", min=0.1, metavar="S", help="Stop after this time.")] = None,
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Record what travels on the mesh into MCAP files, until Ctrl-C. The robot's own recorder keeps running."""
    settings = {
        "folder": str(out.resolve()), "only": only or (), "without": without or (),
        "compression": compression, "jpeg_quality": jpeg, "per_occasion": False,
    }  # fmt: skip
    sys.exit(asyncio.run(record_mesh(RobotChoice(robot, site), settings, seconds, json)))


async def record_mesh(
    choice: RobotChoice, settings: dict[str, Any], seconds: float | None, as_json: bool = False
) -> int:
    """Records until interrupted, or for `seconds`, and returns the exit code.

    `settings` are fields of the recorder's configuration. Raises MeshError when there is no mesh, ConfigError for a
    setting that the recorder does not take.
    """
    component = load_component(CAPTURE)
    try:
        config = msgspec.convert(settings, component.config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"record: {field_text(error, component.config)}") from error
    if left_out := unrecorded():
        print(f"not recorded, as declared: {', '.join(left_out)}", file=sys.stderr)
    async with joined(choice, frames=True) as link:
        resolved = link.run_dir.resolved()
        clock = FollowedClock() if resolved.get("clock") == "sim" else link.clock
        robot = await link.described()
        name = f"record-{os.getpid()}"
        async with Node(
            name, link.bus, clock, robot, robot_name=link.robot, module=CAPTURE.module, config=config, profile=resolved
        ) as node:
            with interrupt_event() as end, going_on(), StatusLine(sys.stderr if as_json else None) as line:
                display = _RecordingDisplay(line, as_json)
                node.on(RECORDING.of(name), display.show)
                await _run_until(component.run(node, config), end, display.failed, seconds)
                with suppress(TimeoutError):
                    async with asyncio.timeout(END_S):
                        await display.ended.wait()
    return display.finish()


async def _run_until(work: Any, end: asyncio.Event, failed: asyncio.Event, seconds: float | None) -> None:
    """Runs the recorder until one of the events is set or the time has passed; cancelled, it closes its file."""
    waits = [asyncio.ensure_future(event.wait()) for event in (end, failed)]
    working = asyncio.ensure_future(work)
    await asyncio.wait((working, *waits), timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
    for task in (*waits, working):
        task.cancel()
    with suppress(asyncio.CancelledError):
        await working


class _RecordingDisplay:
    """Shows a recording: on a terminal one line rewritten in place, elsewhere the name of each file."""

    def __init__(self, line: StatusLine, as_json: bool = False) -> None:
        self.failed = asyncio.Event()
        self.ended = asyncio.Event()
        self._line = line
        self._as_json = as_json
        self._newest: Recording | None = None
        self._files: set[str] = set()

    def show(self, recording: Recording) -> None:
        before, self._newest = self._newest, recording
        new = [file for file in recording.disturbed if before is None or file not in before.disturbed]
        if not recording.ended:
            self._files.add(recording.file)
            for file in new:
                self._line.print(f"cocoro: {describe_disturbance(file)}", sys.stderr)
        if recording.ended:
            self.ended.set()
        elif recording.fault:
            self.failed.set()
        elif self._line.shown:
            self._line.show(_recording_line(recording))
        elif not self._as_json and recording.file and (before is None or before.file != recording.file):
            print(recording.file, flush=True)

    def finish(self) -> int:
        """Prints the summary, disturbed files and the fault, and returns the exit code."""
        newest = self._newest
        if newest is None:
            complain("nothing was recorded")
            return exits.FAILED
        others = len(self._files - {newest.file, ""} - {file.file for file in newest.disturbed})
        others += sum(file.became == "moved" and file.now != newest.file for file in newest.disturbed)
        tell(self._as_json, msgspec.to_builtins(newest), _recording_line(newest, others))
        for file in newest.disturbed:
            print(f"cocoro: {describe_disturbance(file)}", file=sys.stderr)
        if newest.fault:
            print(f"cocoro: {newest.fault}", file=sys.stderr)
        return exits.FAILED if newest.fault or newest.removed else exits.DONE


def _recording_line(recording: Recording, others: int = 0) -> str:
    """One line about a recording; `others` is the number of its files besides the newest."""
    counts = sum(recording.dropped.values()), sum(recording.lost.values())
    missing = "".join(f", {count} {word}" for count, word in zip(counts, ("dropped", "lost"), strict=True) if count)
    more = f" and {others} before it" if others > 0 else ""
    where = f"{recording.file}{more}" if recording.file else "no file is left" if others <= 0 else f"{others} files"
    return f"{where}: {recording.messages} messages, {recording.size_bytes / 1e6:.1f} MB{missing}"
