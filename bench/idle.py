"""Measures what a robot that waits writes to its captures, by kind of message.

    python -m bench.idle [--seconds 120] [--sensors ideal|real] [--frames 640x480@30] [--whole]

Starts the simulated robot as processes with the recorder of its profile, waits, stops it, and reads the captures: size
on disk of an hour at this rate, and the share of each key, packed as the recorder packs them. `--whole` records every
frame, to compare with.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import Counter
from pathlib import Path

import psutil

from apps.captures.info import missing_of
from apps.captures.reader import Capture
from bench.ended import cocoro, leave_when_ended
from cocoro.clock import NS
from deploy.rundir import RunDir
from services.capture.file import LARGE_BYTES
from services.capture.folder import captures
from services.capture.packing import Packer

ROBOT = "bench-idle"
START_S = 5.0
"""The robot's start is not idling."""
PIECE_S = 0.1
"""Messages of about this time share a chunk."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--sensors", default="real")
    parser.add_argument("--frames", default="640x480@30")
    parser.add_argument("--whole", action="store_true")
    options = parser.parse_args()
    leave_when_ended()
    with tempfile.TemporaryDirectory(prefix="cocoro-") as name:
        folder = Path(name)
        os.environ |= {"COCORO_RUN_DIR": str(folder / "run"), "COCORO_CAPTURE_DIR": str(folder / "captures")}
        settings = ["--sensors", options.sensors, "--frames", options.frames, "--set", f'robot="{ROBOT}"']
        settings += ["--set", "service.capture.idle_period_s=0.0"] if options.whole else []
        try:
            cocoro("up", "sim", *settings, "--detach")
            time.sleep(START_S)
            recorder = psutil.Process(RunDir(ROBOT).claims()["capture"].pid)
            before, began_s, size = recorder.cpu_times(), time.monotonic(), _size(folder / "captures")
            time.sleep(options.seconds)
            after, lasted_s = recorder.cpu_times(), time.monotonic() - began_s
            grown, rss_mb = _size(folder / "captures") - size, recorder.memory_info().rss / 1e6
        finally:
            cocoro("down", "--robot", ROBOT)
        cpu = (after.user + after.system - before.user - before.system) / lasted_s
        print(f"{options.sensors} sensors, {options.frames}: {grown / lasted_s * 3600 / 1e6:.0f} MB an hour on disk")
        print(f"recorder: {100 * cpu:.1f}% of one core, {rss_mb:.0f} MB resident, over {lasted_s:.0f} s")
        _kinds(captures(folder / "captures", ROBOT))


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("*.mcap"))


def _kinds(paths: list[Path]) -> None:
    """Prints the captures, and packed sizes by key."""
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
        print(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")
    for key, size in packed.most_common(14):
        out = f", {left_out[key]} left out" if left_out[key] else ""
        rate = messages[key] / seconds
        print(f"  {key.partition('/')[2]:<24} {rate:6.1f} Hz {3600 * size / seconds / 1e6:8.1f} MB an hour{out}")


def _pack(packer: Packer, piece: bytes) -> bytes:
    return (packer.pack if len(piece) >= LARGE_BYTES else packer.pack_small)(piece)[1]


if __name__ == "__main__":
    main()
