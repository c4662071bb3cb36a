"""`cocoro record`: the recorder in the operator's terminal."""

from __future__ import annotations

import asyncio
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from apps.cli import exits
from apps.cli.ending import told_to_end
from apps.cli.link import joined
from apps.cli.options import RobotChoice
from apps.cli.output import going_on
from cocoro.clock import FollowedClock
from cocoro.component import load as load_component
from cocoro.errors import ConfigError
from cocoro.messages import Recording
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import RECORDING
from deploy import processes, robot_time
from services.capture.whereabouts import told

RECORDER = "capture"
"""The process whose component does it: loaded by name, since the API knows no services."""
LAST_WORDS_S = 1.0
"""How long the recorder's last word takes at most, after it has ended."""
CLEAR = "\r\x1b[K"


async def record(where: RobotChoice, settings: dict[str, Any], seconds: float | None) -> int:
    """Record until interrupted, or for so long. Raises MeshError when there is no mesh."""
    row = processes.named(RECORDER)
    component = load_component(row)
    try:
        config = msgspec.convert(settings, component.config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"record: {error}") from error
    async with joined(where, frames=True) as link:
        resolved = link.run_dir.resolved()
        description, measured = (Path(file) if (file := resolved.get(name)) else None for name in _DESCRIPTIONS)
        clock = FollowedClock() if resolved.get("clock") == "sim" else robot_time.clock(link.run_dir.path)
        robot = Robot.load(description, measured)
        name = f"record-{os.getpid()}"
        async with Node(name, link.bus, clock, robot, robot_name=link.robot, module=row.module, config=config) as node:
            view = _RecordingDisplay()
            node.on(RECORDING.of(name), view.show)
            with told_to_end() as end, going_on():
                await _work(component.run(node, config), end, view.failed, seconds)
                with suppress(TimeoutError):
                    await asyncio.wait_for(view.ended.wait(), LAST_WORDS_S)
    return view.last_words()


_DESCRIPTIONS = ("description", "measured")


async def _work(work: Any, end: asyncio.Event, failed: asyncio.Event, seconds: float | None) -> None:
    """Run until it is told to end; the recorder then closes its file."""
    waits = [asyncio.ensure_future(event.wait()) for event in (end, failed)]
    working = asyncio.ensure_future(work)
    await asyncio.wait((working, *waits), timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
    for task in (*waits, working):
        task.cancel()
    with suppress(asyncio.CancelledError):
        await working


class _RecordingDisplay:
    """A line that is written over, on a terminal; elsewhere each file's name."""

    def __init__(self) -> None:
        self.failed = asyncio.Event()
        self.ended = asyncio.Event()
        self._newest: Recording | None = None
        self._files: set[str] = set()

    def show(self, recording: Recording) -> None:
        before, self._newest = self._newest, recording
        new = [file for file in recording.disturbed if before is None or file not in before.disturbed]
        if not recording.ended:
            self._files.add(recording.file)
            for file in new:
                print(f"{CLEAR if sys.stdout.isatty() else ''}cocoro: {told(file)}", file=sys.stderr, flush=True)
        if recording.ended:
            self.ended.set()
        elif recording.fault:
            self.failed.set()
        elif sys.stdout.isatty():
            print(f"{CLEAR}{_line(recording)}", end="", flush=True)
        elif recording.file and (before is None or before.file != recording.file):
            print(recording.file, flush=True)

    def last_words(self) -> int:
        newest = self._newest
        if newest is None:
            print("nothing was recorded")
            return exits.FAILED
        others = len(self._files - {newest.file, ""} - {file.file for file in newest.disturbed})
        others += sum(file.became == "moved" and file.now != newest.file for file in newest.disturbed)
        print(f"{CLEAR if sys.stdout.isatty() else ''}{_line(newest, others)}")
        for file in newest.disturbed:
            print(f"cocoro: {told(file)}", file=sys.stderr)
        if newest.fault:
            print(f"cocoro: {newest.fault}", file=sys.stderr)
        return exits.FAILED if newest.fault or newest.removed else exits.DONE


def _line(recording: Recording, others: int = 0) -> str:
    """`others`: how many files there are besides."""
    missing = sum(recording.dropped.values()), sum(recording.lost.values())
    told = "".join(f", {count} {word}" for count, word in zip(missing, ("dropped", "lost"), strict=True) if count)
    more = f" and {others} before it" if others > 0 else ""
    where = f"{recording.file}{more}" if recording.file else "no file is left" if others <= 0 else f"{others} files"
    return f"{where}: {recording.messages} messages, {recording.size_bytes / 1e6:.1f} MB{told}"
