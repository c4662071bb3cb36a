"""Measures how fast captures become a LeRobotDataset: `python -m bench lerobot [FOLDER]`.

Without FOLDER, which has captures, 100 fetches are rehearsed for it (`--fetches`), with frames of 160 x 120 at 10 Hz
(`--frames`). The export runs in this process, from files to files; the figure is captured time over its wall time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

from apps.captures.export import lerobot
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from bench.exports import size_of
from bench.report import Report
from bench.trials import add_frames, number_of, sized
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from services.executive.tasks import FetchTask


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", nargs="?", type=Path, metavar="FOLDER", help="captures")
    parser.add_argument("--fetches", type=number_of, help="rehearsed for it (100)")
    add_frames(parser, "160x120@10")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "dataset"
        captures = chosen.folder
        if captures is None:
            captures = Path(place) / "captures"
            captures.mkdir()
            for seed in range(sized(chosen, chosen.fetches, 100, 3)):
                _rehearsed(seed, chosen.frames, captures, report)
        _export(captures, out, report)


def _rehearsed(seed: int, frames: dict[str, int | float], folder: Path, report: Report) -> None:
    path = folder / f"fetch-{seed:04}.mcap"
    task = FetchTask(label="red_can")
    fields: dict[str, Any] = dict(frames)
    result = rehearse(RehearsalRequest(task=task, seed=seed, record=str(path), **fields))
    report.say(f"{path.name}: {result['outcome']}")


def _export(captures: Path, out: Path, report: Report) -> None:
    files = lerobot.files_of([captures])
    lasted = [_length_s(path) for path in files]
    began_s, cpu_s = time.perf_counter(), time.process_time()
    made = lerobot.export(files, out)
    took_s, used_s = time.perf_counter() - began_s, time.process_time() - cpu_s
    report.share("captures that became an episode", made.episodes, len(files))
    report.value("captured time", [sum(lasted)], "s")
    report.value("time in episodes", [made.seconds], "s")
    report.value("export, wall time", [took_s], "s")
    report.value("export, processor time", [used_s], "s")
    report.value("size of the dataset beside the captures", [size_of(out) / sum(map(size_of, files))], "x")
    report.ratio("captured time / export's wall time", [sum(lasted)], [took_s], at_least=5.0)
    report.ratio("time in episodes / export's wall time", [made.seconds], [took_s], at_least=5.0)
    report.notes += [f"left out: {what}" for what in made.left_out]


def _length_s(path: Path) -> float:
    with Capture.open(path) as capture:
        return (capture.end_ns - capture.start_ns) / NS
