"""Measures captures: the recorder's cost, what a kill loses, replay, re-execution, and the compression of frames.

    python -m bench capture                                   # all of it
    python -m bench capture traffic [--sensors ideal|real] [--compression lz4]
    python -m bench capture kill [--times 20]
    python -m bench capture reexecute again                   # on what `traffic` recorded, which they run, too
    python -m bench capture frames

`traffic` starts the simulated robot as processes with its recorder, lets it fetch the red can, and reports the
recorder's CPU time (from the operating system) and its dropped and lost messages. `kill` sends the recorder SIGKILL
at random moments while a stand-in for a robot publishes, and measures how much is missing. `reexecute` re-executes
perception and planning on what `traffic` recorded. `again` replays that to another recorder and compares the two
captures. `frames` compresses rendered frames of both kinds of sensors by each method, in one thread.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import psutil

from apps.captures.info import report as contents_of
from apps.captures.reexecute import describe_result, reexecute
from apps.captures.rewrite import rewrite
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from bench.live import NAME, Operator, operator
from bench.report import Report, Table, number, turns
from bench.trials import number_of, one_of, sized
from cocoro import topics
from cocoro.bus.endpoints import default
from cocoro.bus.zenoh import ZenohBus
from cocoro.capture.reader import Capture
from cocoro.clock import NS, RealClock
from cocoro.errors import CocoroError
from cocoro.keys import recorder_key
from cocoro.messages import BaseState, Frame
from cocoro.node import Node
from cocoro.robot import Robot
from services.capture.packing import Compression, Packer
from services.executive.tasks import FetchTask
from sim.kinds import Sensors

PARTS = ("traffic", "reexecute", "kill", "frames", "again")
SHORT_PARTS = PARTS[:-1]
"""A replay takes as long as its messages did, and has no ratio."""
COCORO = [sys.executable, "-m", "apps.cli.main"]
HEARD_S, LOOK_S = 10.0, 0.2
"""Longest wait for a replay's last messages at the second recorder, and the period of the check."""
NOT_REPLAYED = ("alive", "requests", "recorder", "asker")
"""Tokens of those who live, and what was asked of them."""
SHARE_PERCENT = 10.0
"""The recorder's share of a core, at most."""
NOTE = (
    "The recorder's time with noisy frames, by 8 s of samples on a busy machine: 58% in the writer's thread, two "
    "thirds of it zstd; 26% in zenoh's threads; 16% in the loop. The colour takes 1.2 of the 1.7 ms that zstd takes "
    "for such a frame, and 0.2 without entropy coding, at 1.4 times the size. Other tables, matches and windows "
    "change neither."
)
PROFILE = """
clock = "sim"
processes = ["capture", "sim", "perception", "planning", "executive"]
[service.sim]
sensors = "{sensors}"
[service.capture]
folder = "{folder}"
compression = "{compression}"
min_free_mb = 100.0
per_occasion = true
[service.perception]
record_steps = true
[service.planning]
record_steps = true
"""
LISTENER = """
clock = "sim"
processes = ["capture"]
[service.capture]
folder = "{folder}"
per_occasion = false
"""


class Form(NamedTuple):
    """How long each part lasts."""

    traffic_s: float
    kills: int
    replayed_s: float
    frames_s: float


FULL, SHORT = Form(15.0, 10, 20.0, 4.0), Form(3.0, 1, 1.0, 0.6)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "parts", nargs="*", type=one_of(PARTS), metavar="PART", help=f"{', '.join(PARTS)}; without one all"
    )
    parser.add_argument("--seconds", type=float, help="of the traffic (15)")
    parser.add_argument("--sensors", choices=["ideal", "real"], help="of the traffic (both; in the short form real)")
    parser.add_argument("--compression", choices=["zstd", "lz4", "none"], default="zstd", help="of the traffic (zstd)")
    parser.add_argument("--times", type=number_of, help="kills (10)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    form = SHORT if chosen.short else FULL
    form = form._replace(
        traffic_s=sized(chosen, chosen.seconds, FULL.traffic_s, SHORT.traffic_s),
        kills=sized(chosen, chosen.times, FULL.kills, SHORT.kills),
    )
    parts = chosen.parts or (SHORT_PARTS if chosen.short else PARTS)
    with tempfile.TemporaryDirectory(prefix="cocoro-") as name:
        folder = Path(name)
        recorded = folder
        if set(parts) & {"traffic", "reexecute", "again"}:
            both = "traffic" in parts and not chosen.short
            report.notes.append(NOTE)
            for sensors in [chosen.sensors] if chosen.sensors else ["ideal", "real"] if both else ["real"]:
                recorded = folder / sensors
                recorded.mkdir()
                traffic(recorded, form.traffic_s, sensors, chosen.compression, report)
        if "reexecute" in parts:
            execute(recorded, report)
        if "again" in parts:
            again(recorded, form.replayed_s, report)
        if "kill" in parts:
            asyncio.run(kill(folder, form.kills, report))
        if "frames" in parts:
            frames(folder, form.frames_s, report)


def _up(cocoro: Operator, profile: Path, text: str) -> None:
    profile.write_text(text)
    code, said, _ = cocoro("up", str(profile), "--detach")
    if code:
        raise CocoroError(f"the robot did not start: {said.strip()}")


def traffic(folder: Path, seconds: float, sensors: str, compression: str, report: Report) -> None:
    """Record so many seconds of a live fetch, into a file for it and others around it."""
    with operator() as cocoro:
        _up(
            cocoro,
            folder / "bench.toml",
            PROFILE.format(folder=folder, sensors=sensors, compression=compression),
        )
        recorder = psutil.Process(cocoro.run_dir.claims()["capture"].pid)
        before, started = recorder.cpu_times(), time.monotonic()
        with cocoro.start("fetch", "red_can") as fetch:
            with suppress(subprocess.TimeoutExpired):
                fetch.communicate(timeout=seconds)
            time.sleep(max(seconds - (time.monotonic() - started), 0.0))
            after, lasted_s = recorder.cpu_times(), time.monotonic() - started
            rss_mb = recorder.memory_info().rss / 1e6
            if fetch.poll() is None:
                fetch.send_signal(signal.SIGINT)
                fetch.communicate()
        cocoro("down")
    cpu_s = after.user + after.system - before.user - before.system
    name = f"recorder, {sensors} sensors"
    report.value(f"{name}: share of a core", [100.0 * cpu_s / lasted_s], "%", at_most=SHARE_PERCENT)
    report.value(f"{name}: memory", [rss_mb], "MB")
    found = []
    for path in _recorded(folder):
        with Capture.open(path) as capture:
            found.append(contents_of(capture))
    minutes = sum(each.duration_s for each in found) / 60
    report.value(f"{name}: messages", [sum(each.messages for each in found)], "messages", at_least=1)
    report.value(f"{name}: payloads of a minute", [sum(each.raw_bytes for each in found) / minutes / 1e9], "GB")
    report.value(f"{name}: disk space of a minute", [sum(each.size_bytes for each in found) / minutes / 1e9], "GB")
    newest = {key.key: key for each in found for key in each.keys}  # their losses are those since the recorder's start
    report.value(f"{name}: dropped", [sum(key.dropped for key in newest.values())], "messages", at_most=0)
    report.value(f"{name}: lost on the way", [sum(key.lost for key in newest.values())], "messages")
    rows = [
        [key.key.partition("/")[2], number(key.rate_hz), str(key.lost), str(key.dropped)]
        for key in newest.values()
        if key.lost or key.dropped or key.key.endswith("kinect/frame")
    ]
    report.tables.append(Table(f"{name}: frames, and what was lost", ["key", "Hz", "lost", "dropped"], rows))


def _recorded(folder: Path) -> list[Path]:
    """The captures of the traffic, in order."""
    return sorted(folder.glob("*.mcap"))


def execute(folder: Path, report: Report) -> None:
    """Execute perception and planning again; every step whose inputs were recorded must give the same outputs."""
    for service in ("perception", "planning"):
        with ExitStack() as stack:
            opened = [stack.enter_context(Capture.open(path)) for path in _recorded(folder)]
            result = reexecute(opened, service)
        possible = result.steps - result.left_out - result.unsettled - result.not_executable
        if result.equal < possible:
            report.notes += [line.strip() for line in describe_result(result)]
        report.share(f"re-execution, {service}: steps equal to the bit", result.equal, possible, at_least=possible)
        report.value(f"re-execution, {service}: outputs compared", [result.outputs], "outputs", at_least=1)
        report.value(f"re-execution, {service}: inputs not recorded", [result.not_executable], "steps")
        report.value(f"re-execution, {service}: speed", [result.speed], "times real time")


def again(folder: Path, seconds: float, report: Report) -> None:
    """Replay the largest capture, at most so many seconds of it, to another recorder; compare payloads and order."""
    largest = max(_recorded(folder), key=lambda path: path.stat().st_size)
    first, heard = folder / "again" / "first.mcap", folder / "again" / "heard"
    heard.mkdir(parents=True)
    with Capture.open(largest) as capture:
        rewrite(
            capture, first, Packer("zstd"), start_ns=capture.start_ns, end_ns=capture.start_ns + round(seconds * NS)
        )
    played = _published(first)
    with operator() as cocoro:
        _up(cocoro, folder / "again" / "listener.toml", LISTENER.format(folder=heard))
        code, said, _ = cocoro("replay", str(first))
        if code:
            raise CocoroError(f"replay: {said.strip()}")
        (second,) = heard.glob("*.mcap")
        give_up_s = time.monotonic() + HEARD_S
        while _count(_published(second)) < _count(played) and time.monotonic() < give_up_s:
            time.sleep(LOOK_S)  # the last messages may be on their way, or wait to be written
        cocoro("down")
    found = _published(second)
    different = sorted(key for key in played.keys() | found.keys() if played[key] != found[key])
    report.notes += [f"replayed and recorded again, not the same: {key}" for key in different]
    same = len(played) - len(set(different) & played.keys())
    report.share(
        "record, replay, record: keys with the same payloads in order", same, len(played), at_least=len(played)
    )
    report.value("record, replay, record: messages", [_count(played)], "messages", at_least=1)


def _count(published: dict[str, list[int]]) -> int:
    return sum(map(len, published.values()))


def _published(path: Path) -> dict[str, list[int]]:
    """The messages that components published, by key, without those of recorders."""
    found: dict[str, list[int]] = defaultdict(list)
    with Capture.open(path) as capture:
        for each in capture.messages():
            service, _, topic = each.key.removeprefix(f"{NAME}/").partition("/")
            if service != "capture" and topic not in NOT_REPLAYED:
                found[each.key].append(hash(bytes(each.payload)))
    return found


async def kill(folder: Path, times: int, report: Report) -> None:
    """The time from the last recorded message to the recorder's death."""
    draw, robot = random.Random(times), Robot.load()
    async with (
        await ZenohBus.open(default("bench", "bench", folder / "run")) as bus,
        Node("base", bus, RealClock(), robot, robot_name="bench") as base,
    ):
        base.ready()
        publishing = asyncio.create_task(_publish(base))
        missing_s = [await _kill_one(bus, folder, 0.5 + draw.random()) for _ in range(times)]
        publishing.cancel()
    report.value("missing after the recorder is killed", missing_s, "s")
    report.value("missing after the recorder is killed, the most", [max(missing_s)], "s")


async def _kill_one(bus: ZenohBus, folder: Path, after_s: float) -> float:
    """Seconds from the last state in the file to the kill. All earlier states must be there."""
    appeared = asyncio.Event()
    watch = bus.watch_alive(recorder_key("bench", "*"), lambda _, alive: appeared.set() if alive else None)
    out = folder / f"kill-{time.time_ns()}"
    recorder = await asyncio.create_subprocess_exec(
        *COCORO, "record", "--out", str(out), "--robot", "bench",
        env=os.environ | {"COCORO_RUN_DIR": str(folder / "run")}, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    await appeared.wait()
    watch.close()
    await asyncio.sleep(after_s)
    recorder.kill()
    killed_ns = time.time_ns()
    await recorder.wait()
    (path,) = out.glob("*.mcap")
    with Capture.open(path) as capture:
        states = list(capture.messages("base/state"))
        if capture.problems:
            raise CocoroError(f"{path.name}: {capture.problems}")
    sequences = [each.sequence for each in states]
    if sequences != list(range(sequences[0], sequences[-1] + 1)):
        raise CocoroError(f"{path.name}: a message in the middle is missing")
    return (killed_ns - states[-1].log_ns) / 1e9


async def _publish(base: Node) -> None:
    """200 states and 30 frames of 1.5 MB a second."""
    noise = os.urandom(640 * 480 * 5)
    tick = 0
    while True:
        base.publish(
            topics.BASE_STATE,
            BaseState(odometry_m=(tick / 200, 0.0), odometry_yaw_rad=0.0, speed_mps=0.0, turn_rate_radps=0.0),
        )
        if tick % 7 == 0:
            view = memoryview(noise)
            pixels = Frame(width=640, height=480, colour=view[: 640 * 480 * 3], depth=view[640 * 480 * 3 :])
            base.publish(topics.FRAME, pixels)
        tick += 1
        await asyncio.sleep(0.005)


def frames(folder: Path, seconds: float, report: Report) -> None:
    """Each method packs the same frames, in turns."""
    kinds: tuple[Sensors, ...] = ("ideal", "real")
    for sensors in kinds:
        path = folder / "frames.mcap"
        request = RehearsalRequest(
            task=FetchTask(label="red_can"), sensors=sensors, timeout_s=seconds, record=str(path)
        )
        rehearse(request)
        with Capture.open(path) as capture:
            payloads = [bytes(each.payload) for each in list(capture.messages("kinect/frame"))[6::4]]
        path.unlink()
        packed = turns(3, zstd=partial(_pack, "zstd", payloads), lz4=partial(_pack, "lz4", payloads))
        for compression, made in zip(("zstd", "lz4"), packed, strict=True):
            name = f"frames, {sensors} sensors, {compression}"
            raw = [float(len(payload)) for payload in payloads]
            report.ratio(f"{name}: raw / packed", raw, [size for _, size in made[0]], better="more")
            report.value(f"{name}: time of one", [spent_ms for turn in made for spent_ms, _ in turn], "ms")


def _pack(compression: Compression, payloads: list[bytes]) -> list[tuple[float, float]]:
    """CPU time, ms, and packed size of each frame."""
    packer, made = Packer(compression), []
    for payload in payloads:
        begun_ns = time.process_time_ns()
        _, packed = packer.pack(payload)
        made.append(((time.process_time_ns() - begun_ns) / 1e6, float(len(packed))))
    return made
