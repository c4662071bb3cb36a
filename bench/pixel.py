"""Measures from pixel to motor: from a frame's publication until the first wheel command that used it is at the base.

A simulated robot fetches a can, as processes in real time with real sensors, 640 x 480 at 30 Hz, and everything
recorded. The times come from its capture's own records, as `cocoro capture latency FILE` gives them for any capture.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from apps.captures.latency import latency
from bench.live import NAME, Operator, operator
from bench.report import Report, Table, number
from cocoro.capture.reader import Capture
from cocoro.errors import CocoroError

STAGES = ("perception", "planning", "pixel to motor")
BOUNDS_MS = {"pixel to motor": (12.0, 30.0)}
"""Of a stage: the most in the median, and for 99 percent."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--fetches", type=int, default=3, help="each with a robot that is started for it (3)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    medians: dict[str, list[float]] = {stage: [] for stage in STAGES}
    p99s: dict[str, list[float]] = {stage: [] for stage in STAGES}
    rows = []
    for run in range(1 if chosen.short else chosen.fetches):
        with operator() as cocoro:
            path = recorded_fetch(cocoro)
            with Capture.open(path) as capture:
                found = latency([capture])
        report.say(f"fetch {run + 1}: {found.used} of {found.frames} frames led to a wheel command")
        for stage in found.stages:
            medians[stage.name].append(stage.median_ms)
            p99s[stage.name].append(stage.p99_ms)
            rows.append([str(run + 1), stage.name, *map(number, (stage.median_ms, stage.p99_ms, stage.worst_ms))])
        report.share(f"frames that became detections, fetch {run + 1}", found.seen, found.frames)
    for name in STAGES:
        median_ms, p99_ms = BOUNDS_MS.get(name, (None, None))
        report.value(f"{name}, median of a fetch", medians[name], "ms", at_most=median_ms)
        report.value(f"{name}, 99% of a fetch", p99s[name], "ms", at_most=p99_ms)
    report.tables.append(Table("Each fetch, ms", ["fetch", "stage", "median", "99%", "worst"], rows))


def recorded_fetch(cocoro: Operator) -> Path:
    """Fetch the red can with the profile `sim` and real sensors. Returns the fetch's capture. Raises CocoroError when
    the robot did not start or did not fetch."""
    code, said, _ = cocoro("up", "sim", "--detach", "--sensors", "real")
    if code:
        raise CocoroError(f"the robot did not start: {said.strip()}")
    code, said, _ = cocoro("fetch", "red_can", "--robot", NAME)
    path = re.search(r"recorded in (\S+)", said)
    if code or path is None:
        raise CocoroError(f"the robot did not fetch: {said.strip()}")
    cocoro("down", "--robot", NAME)
    return Path(path[1])
