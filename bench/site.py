"""Fetches over a site of three hosts with a network between them: `python -m bench site --count 20 --delay-ms 20 ...`.

The robot is simulated on the first host, perception, planning and executive run on the second, the operator sits at the
third; mutual TLS and access rules everywhere. Each fetch starts the robot anew. Needs root, for network namespaces.
"""

from __future__ import annotations

import argparse
import asyncio
import tempfile
from pathlib import Path

from bench.report import Report
from bench.site_lab import lab
from bench.trials import Runs, number_of, sized
from cocoro.errors import ConfigError
from sim.network.network import obstacle


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="fetches, each with a robot that is started for it (20)")
    parser.add_argument("--delay-ms", type=float, default=1.0, help="of each way between two hosts (1)")
    parser.add_argument("--jitter-ms", type=float, default=0.0, help="added to it, uniform from 0 to this (0)")
    parser.add_argument("--loss", type=float, default=0.0, help="share of the packets that are lost (0)")
    parser.add_argument("--rate-mbps", type=float, help="of each way between two hosts, Mbit/s (without limit)")
    parser.add_argument("--sensors", choices=["ideal", "real"], default="real")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if why := obstacle():
        raise ConfigError(f"there can be no network of hosts here: {why}")
    runs = Runs(report)
    took: list[float] = []
    for number in range(1, sized(chosen, chosen.count, 20, 1) + 1):
        with (
            tempfile.TemporaryDirectory(prefix="site") as folder,
            lab(Path(folder), seed=number, sensors=chosen.sensors) as site,
        ):
            rate_bps = None if chosen.rate_mbps is None else chosen.rate_mbps * 1e6
            site.network.links().set(
                delay_ms=chosen.delay_ms, jitter_ms=chosen.jitter_ms, loss=chosen.loss, rate_bps=rate_bps
            )
            site.up()
            fetched = asyncio.run(site.fetch())
        runs.add(fetched.well, f"{number}: {fetched.last_line}", [fetched.said, str(fetched.truth)])
        if fetched.task_s is not None:
            took.append(fetched.task_s)
    runs.share("fetched over three hosts, nothing else touched")
    if took:
        report.value("the task, by the robot's clock", took, "s")
