"""Measures what a robot that waits writes to its captures, by kind of message: `python -m bench idle [--whole]`.

Starts the simulated robot as processes with the recorder of its profile, waits, stops it, and reads the captures: size
on disk of an hour at this rate, and the share of each key, packed as the recorder packs them. `--whole` records every
frame, to compare with.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from pathlib import Path

import psutil

from apps.captures.info import missing_of
from bench.live import NAME, operator
from bench.report import Report, Table, number
from bench.trials import sized
from cocoro.capture.folder import captures
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.errors import CocoroError
from services.capture.file import LARGE_BYTES
from services.capture.packing import Packer

START_S = 5.0
"""The robot's start is not idling."""
PIECE_S = 0.1
"""Messages of about this time share a chunk."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, help="how long (120)")
    parser.add_argument("--sensors", choices=["ideal", "real"], default="real")
    parser.add_argument("--frames", default="640x480@30", metavar="WxH@HZ")
    parser.add_argument("--whole", action="store_true", help="record every frame")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    with operator() as cocoro:
        folder = cocoro.captures
        settings = ["--sensors", chosen.sensors, "--frames", chosen.frames]
        settings += ["--set", "service.capture.idle_period_s=0.0"] if chosen.whole else []
        code, said, _ = cocoro("up", "sim", "--detach", *settings)
        if code:
            raise CocoroError(f"the robot did not start: {said.strip()}")
        time.sleep(START_S)
        recorder = psutil.Process(cocoro.run_dir.claims()["capture"].pid)
        before, began_s, size = recorder.cpu_times(), time.monotonic(), _size(folder)
        time.sleep(sized(chosen, chosen.seconds, 120.0, 5.0))
        after, lasted_s = recorder.cpu_times(), time.monotonic() - began_s
        grown, rss_mb = _size(folder) - size, recorder.memory_info().rss / 1e6
        cocoro("down")
        share = (after.user + after.system - before.user - before.system) / lasted_s
        report.value("written in an hour at this rate", [grown / lasted_s * 3600 / 1e6], "MB")
        report.value("recorder's share of a core", [100.0 * share], "%")
        report.value("recorder's memory", [rss_mb], "MB")
        report.tables.append(_kinds(captures(folder, NAME), report))


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("*.mcap"))


def _kinds(paths: list[Path], report: Report) -> Table:
    """The keys by their packed size; says the size of each capture."""
    packed: Counter[str] = Counter()
    messages: Counter[str] = Counter()
    left_out: Counter[str] = Counter()
    packer, seconds = Packer("zstd"), 0.0
    for path in paths:
        with Capture.open(path) as capture:
            seconds += (capture.end_ns - capture.start_ns) / NS
            left_out.update(missing_of(capture).left_out)
            for key in capture.keys:
                piece, until_ns = b"", 0
                for record in capture.messages(key):
                    messages[key] += 1
                    if record.log_ns > until_ns or len(record.payload) >= LARGE_BYTES:
                        packed[key] += len(_pack(packer, piece))
                        piece, until_ns = b"", record.log_ns + round(PIECE_S * NS)
                    piece += record.payload
                packed[key] += len(_pack(packer, piece))
        report.say(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")
    rows = [
        [
            key.partition("/")[2],
            number(messages[key] / seconds),
            number(3600 * size / seconds / 1e6),
            str(left_out[key]),
        ]
        for key, size in packed.most_common(14)
    ]
    return Table("Kinds of messages", ["key", "Hz", "packed, MB an hour", "left out"], rows)


def _pack(packer: Packer, piece: bytes) -> bytes:
    return (packer.pack if len(piece) >= LARGE_BYTES else packer.pack_small)(piece)[1]
