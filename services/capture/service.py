"""The recorder as a service: file names, rotation limits and retention."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

from cocoro.clock import NS
from cocoro.component import Implementation
from cocoro.node import Node
from services.capture.config import CaptureConfig, folder_of
from services.capture.file import Packer
from services.capture.keys import KeyFilter, info_of, lossy
from services.capture.log_clock import LogClock
from services.capture.recorder import Ledger, Recorder
from services.capture.sink import DirectSink, ThreadedSink
from services.capture.writer import MB, CaptureWriter, FileLimits, sync_and_close


async def run(node: Node, config: CaptureConfig, log_clock: LogClock | None = None) -> None:
    """Record until cancelled. When the disk refuses, that is reported as a fault and the service keeps running.

    `log_clock` is used in real time only; by default a new one.
    """
    ledger = Ledger(node.robot_name, KeyFilter(node.robot_name, config.only, config.without))
    virtual = node.clock.virtual
    if virtual:
        log_clock = None
    elif log_clock is None:
        log_clock = LogClock()
    started = datetime.now(UTC) if log_clock is None else datetime.fromtimestamp(log_clock.now_ns() / NS, UTC)
    make = partial(_writer, node.robot_name, config, ledger, started)
    sink: ThreadedSink | DirectSink
    if virtual:
        sink = DirectSink(make, config.flush_s)
    else:
        sink = ThreadedSink(make, round(config.memory_mb * MB), config.flush_s, config.sync_s)
    recorder = Recorder(node, ledger, sink, log_clock)
    try:
        recorder.start()
        node.ready()
        await recorder.report()
    finally:
        recorder.close()
        if isinstance(sink, ThreadedSink):
            await asyncio.to_thread(sink.close)
        else:
            sink.close()
        recorder.end()


implementation = Implementation(CaptureConfig, run)


def _writer(
    robot: str, config: CaptureConfig, ledger: Ledger, started: datetime, release: Callable[[int], None] | None
) -> CaptureWriter:
    limits = FileLimits(min_free_bytes=round(config.min_free_mb * MB))
    if config.file is None:
        limits = replace(limits, file_bytes=config.rotate_mb * MB, file_s=config.rotate_s)
    return CaptureWriter(
        _place(robot, config, started),
        Packer(config.compression, config.level),
        limits,
        lambda key, payload: info_of(key, robot, payload),
        ledger.missing,
        release or sync_and_close,
        None if config.jpeg_quality is None else lossy(config.jpeg_quality),
    )


def _place(robot: str, config: CaptureConfig, started: datetime) -> Callable[[int], Path]:
    """The path of the nth file, as a function of n from 1 on."""
    if config.file is not None:
        path = Path(config.file)
        return lambda _: path
    folder = folder_of(config)
    while (folder / file_name(robot, started, 1)).exists():
        started += timedelta(seconds=1)

    def place(number: int) -> Path:
        if config.keep_gb is not None:
            make_room(folder, robot, round(config.keep_gb * 1000 * MB), started)
        return folder / file_name(robot, started, number)

    return place


def file_name(robot: str, started: datetime, number: int) -> str:
    """The name of a run's nth file. Names sort by the wall clock's time at the start of the run."""
    return f"{_run(robot, started)}-{number:03}.mcap"


def _run(robot: str, started: datetime) -> str:
    return f"{robot}-{started:%Y%m%dT%H%M%SZ}"


def captures(folder: Path, robot: str) -> list[Path]:
    """A robot's captures in a folder, oldest first."""
    pattern = re.compile(rf"{re.escape(robot)}-\d{{8}}T\d{{6}}Z-\d{{3,}}\.mcap")
    return sorted(path for path in folder.glob("*.mcap") if pattern.fullmatch(path.name))


def make_room(folder: Path, robot: str, keep_bytes: int, started: datetime | None = None) -> list[Path]:
    """Delete the oldest captures until the others take at most `keep_bytes`, but never the newest one. Returns the
    deleted.

    The current run's files, which began at `started`, count as the newest, in the order of their numbers, whatever
    the wall clock said when others were begun.
    """
    own = "" if started is None else f"{_run(robot, started)}-"
    files = sorted(captures(folder, robot), key=lambda path: _age(path, own))
    sizes = {path: path.stat().st_size for path in files}
    left = sum(sizes.values())
    gone = []
    for path in files[:-1]:
        if left <= keep_bytes:
            break
        with suppress(OSError):
            path.unlink()
            left -= sizes[path]
            gone.append(path)
    return gone


def _age(path: Path, own: str) -> tuple[bool, int, str]:
    """Sort key, oldest first."""
    if own and path.name.startswith(own):
        return True, int(path.stem.rpartition("-")[2]), path.name
    return False, 0, path.name
