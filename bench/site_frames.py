"""Frames and commands between two hosts on networks of several rates: `python -m bench site-frames`.

A camera of stored frames, states and events on one host, a reader of frames that commands wheels on the other, their
gateways, the packer and the unpacker; beside them, a viewer who subscribes to everything over a link of 1 Mbit/s. Each
network has 5 ms of delay each way and loses 1 % of its packets. Then what packing does to the detections, by the truth.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import msgspec
import numpy as np
import psutil

from bench.perception import NEVER_HZ, Ours
from bench.perception_scene import scene
from bench.report import Report, percentile
from bench.site_lab import ROBOT, Lab, lab
from bench.trials import sized
from cocoro.errors import ConfigError
from cocoro.robot import Robot
from deploy.rundir import RunDir
from deploy.site import plan
from deploy.site.component import gateway_of
from services.frames.component import PACKER, unpacker_of
from services.frames.pace import LEVELS
from services.frames.packing import pack, unpack
from sim.network.network import Host, obstacle

RATES = (1000.0, 20.0, 5.0, 1.0)
PATIENCE_S = 90.0
VIEWER = {"rate_bps": 1e6, "queue_bytes": 64_000}
"""The link of who subscribes to everything."""
OBJECTS = 16
ROUNDS = 30


def rates(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(","))


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, help="for each network (20)")
    parser.add_argument("--mbps", type=rates, default=RATES, metavar="N,N", help="rates of the network, Mbit/s")
    parser.add_argument("--delay-ms", type=float, default=5.0, help="of each way between two hosts (5)")
    parser.add_argument("--loss", type=float, default=0.01, help="share of the packets that are lost (0.01)")
    parser.add_argument("--frame-hz", type=float, default=30.0, help="of the camera (30)")
    parser.add_argument("--size", choices=["640x480", "320x240"], default="640x480", help="of its frames")
    parser.add_argument("--no-detections", action="store_true", help="without what packing does to detections")
    parser.add_argument("--no-viewer", action="store_true", help="without the viewer who subscribes to everything")


def started(host: Host, site: Lab, names: Sequence[str]) -> dict[str, subprocess.Popen[bytes]]:
    """Starts some processes of a host's share, without a supervisor."""
    share = plan.read(site.site_of(host)).share_profile(host.name)
    run_dir = RunDir(ROBOT, host.folder / "run")
    run_dir.make()
    run_dir.remember(msgspec.json.encode(msgspec.structs.replace(share, processes=tuple(names))))
    found = {}
    for name in names:
        with (host.folder / f"{name}.log").open("wb") as log:
            argv = [sys.executable, "-m", "deploy.launch", name, "--run-dir", str(run_dir.path)]
            found[name] = host.run(argv, stderr=log)
    return found


def speaker(site: Lab, host: Host, role: str, given: dict[str, Any]) -> subprocess.Popen[str]:
    more = {"robot": ROBOT, "run": str(host.folder / "run"), "way": site.as_person("eve")[1], **given}
    argv = [sys.executable, "-m", "bench.site_frames_speaker", role, json.dumps(more)]
    return host.run(argv, stdout=subprocess.PIPE, text=True)


def over(chosen: argparse.Namespace, mbps: float, seconds: float, report: Report) -> None:
    """Measures one network."""
    width, height = (int(side) for side in chosen.size.split("x"))
    given = {"seconds": seconds, "frame_hz": chosen.frame_hz, "width": width, "height": height}
    with tempfile.TemporaryDirectory(prefix="site") as name, lab(Path(name)) as site:
        site.network.links().set(delay_ms=chosen.delay_ms)
        processes = started(site.body, site, (gateway_of("body").name, PACKER.name))
        processes |= started(site.brain, site, (gateway_of("brain").name, unpacker_of("brain").name))
        site.network.links().set(delay_ms=chosen.delay_ms, loss=chosen.loss, rate_bps=mbps * 1e6)
        ends = {"body": speaker(site, site.body, "body", given), "brain": speaker(site, site.brain, "brain", given)}
        if not chosen.no_viewer:
            site.network.direction("body", "desk").set(delay_ms=chosen.delay_ms, loss=chosen.loss, **VIEWER)
            speaker(site, site.desk, "viewer", given)
        said = {who: ends[who].communicate(timeout=PATIENCE_S + seconds)[0] for who in ("brain", "body")}
        spent = {what: sum(psutil.Process(process.pid).cpu_times()[:2]) for what, process in processes.items()}
        carried = site.network.direction("body", "brain").counts()
        links = (site.body.folder / f"{gateway_of('body').name}.log").read_text(errors="replace").count("lost the link")
    heard = {who: json.loads(text) for who, text in said.items() if text.strip()}
    on = f"{mbps:g} Mbit/s"
    if not heard.get("brain", {}).get("ages"):
        report.notes.append(f"{on}: no frame came")
    else:
        ages = [1e3 * age for age in heard["brain"]["ages"]]
        report.value(f"frames that came, {on}", [len(ages) / seconds], "Hz")
        report.value(f"age of a frame at its arrival, {on}", ages, "ms")
        report.value(f"age of a frame, 99 of 100, {on}", [percentile(ages, 99)], "ms")
        report.value(f"width of a frame, {on}", heard["brain"]["widths"], "px")
    if states := [1e3 * age for age in heard.get("brain", {}).get("states", ())]:
        report.value(f"age of a state at its arrival, 99 of 100, {on}", [percentile(states, 99)], "ms")
    periods = [1e3 * period for period in heard["body"]["periods"]]
    if periods:
        report.value(f"period of commands as they arrive, 99 of 100, {on}", [percentile(periods, 99)], "ms")
        report.value(f"longest period of commands, {on}", [max(periods)], "ms")
    report.notes.append(
        f"{on}: {carried}; links lost: {links}; processor: "
        + ", ".join(f"{what} {spent_s:.1f} s" for what, spent_s in spent.items())
    )


def processor_ms(action: Callable[[], object]) -> float:
    """The median of what an action takes of the processor."""
    took = []
    for _ in range(ROUNDS):
        begun = time.thread_time()
        action()
        took.append(1e3 * (time.thread_time() - begun))
    return median(took)


def detections(report: Report) -> None:
    """What each level of packing takes, and what it does to the detections."""
    cv2.setNumThreads(1)
    robot = Robot.load()
    shown = scene(robot, OBJECTS, 8)
    core = Ours(robot, shown, NEVER_HZ)
    places = {known.label: place for known, place in zip(shown.catalogue, shown.places_m, strict=True)}
    for level in (None, *LEVELS):
        called = "as they are" if level is None else f"1/{level.divisor}, quality {level.quality}"
        away, found, size = [], 0, []
        for frame in shown.frames:
            packed = None if level is None else pack(frame, *level)
            core.prepare(frame if packed is None else unpack(packed))
            core.step()
            size.append(float(len(packed.colour) + len(packed.depth)) if packed is not None else 0.0)
            for one in core.found():
                if one.label in places and one.position_m is not None:
                    found += 1
                    away.append(1e3 * float(np.linalg.norm(one.position_m - places[one.label])))
        report.share(f"objects found and placed, frames {called}", found, OBJECTS * len(shown.frames))
        if away:
            report.value(f"error of their places, frames {called}", away, "mm")
        if level is not None:
            report.value(f"a packed frame {called}", size, "bytes")
            small = pack(shown.frames[0], *level)
            report.value(f"packing {called}", [processor_ms(partial(pack, shown.frames[0], *level))], "ms")
            report.value(f"unpacking {called}", [processor_ms(partial(unpack, small))], "ms")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if why := obstacle():
        raise ConfigError(f"there can be no network of hosts here: {why}")
    seconds = sized(chosen, chosen.seconds, 20.0, 5.0)
    if not chosen.no_detections:
        detections(report)
    for mbps in chosen.mbps:
        over(chosen, mbps, seconds, report)
