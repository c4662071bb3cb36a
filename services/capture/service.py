"""The recorder as a service."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from cocoro.capture.folder import RecordingFolder
from cocoro.clock import NS
from cocoro.component import Implementation
from cocoro.heap import give_back
from cocoro.node import Node
from services.capture.config import CaptureConfig, folder_of
from services.capture.keys import KeyFilter, KeyInfo, info_of, lossy
from services.capture.log_clock import LogClock
from services.capture.packing import Packer
from services.capture.recorder import Ledger, Recorder
from services.capture.sink import DirectSink, ThreadedSink
from services.capture.thinning import ThinningLimits, ThinningWriter
from services.capture.writer import MB, CaptureWriter, FileLimits, sync_and_close

GIVE_BACK_S = 30.0
"""What waits for the disk while an occasion begins, or the machine is busy, leaves holes in the heaps of several
threads. Without giving them back the process grows to the sum of the largest of each."""


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
    recorder = Recorder(node, ledger, sink, log_clock, config.flush_s)
    try:
        recorder.start()
        node.ready()
        if not virtual:
            node.spawn(_give_back())
        await recorder.report()
    finally:
        recorder.close()
        if isinstance(sink, ThreadedSink):
            await asyncio.to_thread(sink.close)
        else:
            sink.close()
        recorder.end()


implementation = Implementation(CaptureConfig, run)


async def _give_back() -> None:
    while True:
        await asyncio.sleep(GIVE_BACK_S)
        await asyncio.to_thread(give_back)


def _writer(
    robot: str, config: CaptureConfig, ledger: Ledger, started: datetime, release: Callable[[int], None] | None
) -> CaptureWriter:
    packer = Packer(config.compression, config.level)
    limits = FileLimits(min_free_bytes=round(config.min_free_mb * MB))
    if config.file is None:
        limits = replace(limits, file_bytes=config.rotate_mb * MB, file_s=config.rotate_s)

    def info(key: str, payload: bytes) -> KeyInfo:
        return info_of(key, robot, payload)

    prepare = None if config.jpeg_quality is None else lossy(config.jpeg_quality)
    to = release or sync_and_close
    if config.file is not None:
        path = Path(config.file)
        return CaptureWriter(lambda _: path, packer, limits, info, ledger.missing, to, prepare)
    reserve_bytes = round((config.min_free_mb + config.rotate_mb) * MB)
    keep_bytes = None if config.keep_gb is None else round(config.keep_gb * 1000 * MB)
    folder = RecordingFolder(folder_of(config), robot, started, keep_bytes, reserve_bytes)
    if not config.per_occasion:
        return CaptureWriter(folder.place, packer, limits, info, ledger.missing, to, prepare)
    thinning = ThinningLimits(config.before_s, round(config.before_mb * MB), config.idle_period_s, config.idle_rotate_s)
    return ThinningWriter(folder, robot, thinning, packer, limits, info, ledger.missing, to, prepare)
