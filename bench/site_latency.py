"""The time on the way from host to host: `python -m bench site-latency`.

A wheel command from a Node on the brain's host to a Node on the robot's, by both hosts' gateways, with mutual TLS,
access rules and all limits. Beside it, in turns in the same processes, raw zenoh over TLS: straight from one program to
the other, which is one connection where the Node's way is three; and over a bare router on each host, which is the
same way without anything of this project. Frames go another way: `python -m bench site-frames`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from bench.report import Report
from bench.site_lab import ROBOT, Lab, lab
from bench.site_speaker import DIRECT, HZ, NODE, ROUTED, ROUTER
from bench.trials import number_of, sized
from cocoro.errors import ConfigError
from deploy.rundir import RunDir
from deploy.site import place, plan
from deploy.site.component import gateway_of
from sim.network.network import Host, obstacle

RAW_PORT, BARE_PORT = 7448, 7449
PATIENCE_S = 60.0


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="commands each way (1500)")
    parser.add_argument("--delay-ms", type=float, default=0.0, help="of the network, each way (0)")


def gateways(site: Lab) -> None:
    """Starts the gateways of both hosts alone, without the robot."""
    for host in (site.body, site.brain):
        share = plan.read(site.site_of(host)).share_profile(host.name)
        name = gateway_of(host.name).name
        run_dir = RunDir(ROBOT, host.folder / "run")
        run_dir.make()
        run_dir.remember(msgspec.json.encode(msgspec.structs.replace(share, processes=(name,))))
        log = (host.folder / f"{name}.log").open("wb")
        host.run([sys.executable, "-m", "deploy.launch", name, "--run-dir", run_dir.path], stderr=log)


def speaker(site: Lab, host: Host, more: dict[str, Any], kind: str = "") -> subprocess.Popen[str]:
    given = {
        "robot": ROBOT,
        "run": str(host.folder / "run"),
        "raw": f"tls/{site.body.address}:{RAW_PORT}",
        "bare": f"tls/{site.body.address}:{BARE_PORT}",
        "credentials": str(site.site_of(host) / place.CREDENTIALS / host.name),
        **more,
    }
    argv = [sys.executable, "-m", "bench.site_speaker", f"{kind}{host.name}", json.dumps(given)]
    return host.run(argv, stdout=subprocess.PIPE, text=True)


def high(times: Sequence[float]) -> float:
    """The 99th percentile."""
    return sorted(times)[int(0.99 * (len(times) - 1))]


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if why := obstacle():
        raise ConfigError(f"there can be no network of hosts here: {why}")
    commands = sized(chosen, chosen.count, 1500, 200)
    seconds = commands / HZ
    more = {"commands": commands, "seconds": seconds}
    took: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory(prefix="site") as name, lab(Path(name)) as site:
        site.network.links().set(delay_ms=chosen.delay_ms)
        gateways(site)
        routers = [speaker(site, host, more, ROUTER) for host in (site.body, site.brain)]
        ends = [speaker(site, host, more) for host in (site.body, site.brain)]
        for end in ends:
            said, _ = end.communicate(timeout=PATIENCE_S + seconds)
            found = json.loads(said)
            took |= {name: [ns / 1e6 for ns in times] for name, times in found.items() if times}
        for router in routers:
            router.wait(PATIENCE_S)
    node, raw, routed = took.get(NODE, []), took.get(DIRECT, []), took.get(ROUTED, [])
    if not node or not raw or not routed:
        raise ConfigError(f"no command came through: {', '.join(sorted(took)) or 'nothing at all'}")
    report.value("a command from host to host, Node to Node", node, "ms")
    report.value("a command from host to host, raw zenoh over TLS, straight", raw, "ms")
    report.value("a command from host to host, raw zenoh over TLS, bare routers", routed, "ms")
    for way, times in (("Node to Node", node), ("raw, straight", raw), ("raw, bare routers", routed)):
        report.value(f"a command, {way}, 99 of 100", [high(times)], "ms")
    for kind, figure in (("median", statistics.median), ("99 of 100", high)):
        report.ratio(f"a command: Node / raw over bare routers, {kind}", *_blocks(node, routed, figure), at_most=1.3)
        report.ratio(f"a command: Node / raw, straight, {kind}", *_blocks(node, raw, figure), at_most=1.3)
    report.share("commands that came, Node to Node", len(node), commands)


def _blocks(node: list[float], raw: list[float], kind: Any) -> tuple[list[float], list[float]]:
    """A figure of each of up to five equal blocks of both series, which were taken in turns."""
    count = max(1, min(5, len(node) // 100, len(raw) // 100))
    return tuple(  # type: ignore[return-value]
        [kind(times[at * len(times) // count : (at + 1) * len(times) // count]) for at in range(count)]
        for times in (node, raw)
    )
