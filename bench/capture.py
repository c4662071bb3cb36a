"""Measures the cost of recording, the loss when a recorder is killed, and the speed of re-execution.

    python bench/capture.py traffic [--seconds 30] [--sensors ideal|real] [--compression zstd]
    python bench/capture.py kill [--times 20]
    python bench/capture.py reexecute
    python bench/capture.py again
    python bench/capture.py frames

`traffic` starts the simulated robot as processes with its recorder, lets it fetch the red can, and reports the
recorder's CPU time (from the operating system) and its dropped and lost messages. `kill` sends the recorder SIGKILL
at random moments while a stand-in for a robot publishes, and measures how much is missing. `reexecute` re-executes
perception and planning on what `traffic` recorded. `again` replays that to another recorder and compares the two
captures. `frames` compresses rendered frames of both kinds of sensors by each method, in one thread.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack
from pathlib import Path

import psutil

from apps.captures.info import report
from apps.captures.reader import Capture
from apps.captures.reexecute import describe_result, reexecute
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from bench.ended import cocoro, leave_when_ended
from cocoro import topics
from cocoro.bus.endpoints import default
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import RealClock
from cocoro.keys import recorder_key
from cocoro.messages import BaseState, Frame
from cocoro.node import Node
from cocoro.robot import Robot
from deploy.rundir import RunDir
from services.capture.packing import Packer
from services.executive.tasks import FetchTask

COCORO = [sys.executable, "-m", "apps.cli.main"]
HEARD_S, LOOK_S = 10.0, 0.2
"""Longest wait for a replay's last messages at the second recorder, and the period of the check."""
PROFILE = """
robot = "calliope"
clock = "sim"
processes = ["capture", "sim", "perception", "planning", "executive"]
[service.sim]
sensors = "{sensors}"
[service.capture]
folder = "{folder}"
compression = "{compression}"
min_free_mb = 100.0
per_occasion = {per_occasion}
[service.perception]
record_steps = true
[service.planning]
record_steps = true
"""


def traffic(folder: Path, seconds: float, sensors: str, compression: str, per_occasion: bool) -> None:
    """Record a live fetch, into one file for it and others around it, or into one."""
    profile = folder / "bench.toml"
    profile.write_text(
        PROFILE.format(folder=folder, sensors=sensors, compression=compression, per_occasion=json.dumps(per_occasion))
    )
    try:
        cocoro("up", str(profile), "--detach")
        recorder = psutil.Process(RunDir("calliope").claims()["capture"].pid)
        before, started = recorder.cpu_times(), time.monotonic()
        written = recorder.io_counters().write_bytes
        done = subprocess.run([*COCORO, "fetch", "red_can"], capture_output=True, text=True, check=False)
        time.sleep(max(seconds - (time.monotonic() - started), 0.0))  # the rest of the measuring time
        after, lasted_s = recorder.cpu_times(), time.monotonic() - started
        written = recorder.io_counters().write_bytes - written
        cpu_s = after.user + after.system - before.user - before.system
        rss_mb = recorder.memory_info().rss / 1e6
    finally:
        cocoro("down")
    print("\n".join(done.stdout.strip().splitlines()[-2:]) if done.stdout else done.stderr)
    print(f"recorder: {100 * cpu_s / lasted_s:.1f}% of one core over {lasted_s:.0f} s, {rss_mb:.0f} MB resident")
    for path in sorted(folder.glob("*.mcap")):
        with Capture.open(path) as capture:
            found = report(capture)
        minutes = found.duration_s / 60
        print(
            f"{found.messages} messages in {found.duration_s:.1f} s; a minute is {found.raw_bytes / minutes / 1e6:.0f} "
            f"MB of payloads, {found.size_bytes / minutes / 1e6:.0f} MB on the disk"
        )
        print(f"dropped {sum(k.dropped for k in found.keys)}, lost on the way {sum(k.lost for k in found.keys)}")
        for key in found.keys:
            if key.lost or key.dropped or key.key.endswith("kinect/frame"):
                print(f"  {key.key}: {key.messages}, {key.rate_hz:.1f} Hz, lost {key.lost}, dropped {key.dropped}")
    print(f"written to the disk: {written / 1e6:.0f} MB")


async def kill(folder: Path, times: int) -> None:
    """The time from the last recorded message to the recorder's death."""
    draw, robot = random.Random(times), Robot.load()
    async with (
        await ZenohBus.open(default("bench", "bench", folder / "run")) as bus,
        Node("base", bus, RealClock(), robot, robot_name="bench") as base,
    ):
        base.ready()
        publishing = asyncio.create_task(_publish(base))
        all_s = [await _kill_one(bus, folder, 0.5 + draw.random()) for _ in range(times)]
        publishing.cancel()
    all_s.sort()
    print(f"{times} kills: missing {all_s[len(all_s) // 2]:.3f} s in the middle, {all_s[-1]:.3f} s at worst")


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
        assert not capture.problems, capture.problems
    sequences = [each.sequence for each in states]
    assert sequences == list(range(sequences[0], sequences[-1] + 1)), "a message in the middle is missing"
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


def execute(folder: Path) -> None:
    for service in ("perception", "planning"):
        with ExitStack() as stack:
            opened = [stack.enter_context(Capture.open(path)) for path in sorted(folder.glob("*.mcap"))]
            print("\n".join(describe_result(reexecute(opened, service))))


def again(folder: Path) -> None:
    """Record, replay and record again; compare the payloads and their order per key."""
    (first,) = folder.glob("*.mcap")
    listener = folder / "listener.toml"
    listener.write_text(
        f'robot = "calliope"\nclock = "sim"\nprocesses = ["capture"]\n[service.capture]\nfolder = "{folder}/again"\n'
    )
    try:
        cocoro("up", str(listener), "--detach")
        subprocess.run([*COCORO, "replay", str(first)], check=True)
        (second,) = (folder / "again").glob("*.mcap")
        played, give_up_s = _published(first), time.monotonic() + HEARD_S
        while _count(_published(second)) < _count(played) and time.monotonic() < give_up_s:
            time.sleep(LOOK_S)  # the last messages may be on their way, or wait to be written
    finally:
        cocoro("down")
    payloads = [played, _published(second)]
    different = sorted(key for key in payloads[0].keys() | payloads[1].keys() if payloads[0][key] != payloads[1][key])
    count = _count(played)
    print(
        f"{count} messages of {len(payloads[0])} keys: {f'not the same: {different}' if different else 'all the same'}"
    )


def _count(published: dict[str, list[int]]) -> int:
    return sum(map(len, published.values()))


def _published(path: Path) -> dict[str, list[int]]:
    """The messages that components published, by key, without those of recorders."""
    found: dict[str, list[int]] = defaultdict(list)
    with Capture.open(path) as capture:
        for each in capture.messages():
            service, _, topic = each.key.removeprefix("calliope/").partition("/")
            if service != "capture" and topic not in ("alive", "requests", "recorder"):
                found[each.key].append(hash(bytes(each.payload)))
    return found


def frames(folder: Path) -> None:
    """CPU time, since the machine may have other work."""
    for sensors in ("ideal", "real"):
        path = folder / f"{sensors}.mcap"
        rehearse(RehearsalRequest(task=FetchTask(label="red_can"), sensors=sensors, record=str(path)))
        with Capture.open(path) as capture:
            payloads = [bytes(each.payload) for each in list(capture.messages("kinect/frame"))[10:250:8]]
        for compression in ("zstd", "lz4"):
            packer = Packer(compression)
            started = time.process_time()
            packed = sum(len(packer.pack(payload)[1]) for payload in payloads)
            each_ms = (time.process_time() - started) / len(payloads) * 1e3
            times = sum(map(len, payloads)) / packed
            print(f"{sensors} sensors, {compression}: {times:.1f} times smaller, {each_ms:.2f} ms a frame")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("traffic", "kill", "reexecute", "again", "frames"))
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--sensors", default="ideal")
    parser.add_argument("--compression", default="zstd")
    parser.add_argument("--times", type=int, default=20)
    options = parser.parse_args()
    leave_when_ended()
    with tempfile.TemporaryDirectory(prefix="cocoro-") as name:
        folder = Path(name)
        os.environ["COCORO_RUN_DIR"] = str(folder / "run")
        if options.what == "frames":
            frames(folder)
            return
        if options.what == "kill":
            asyncio.run(kill(folder, options.times))
            return
        traffic(folder, options.seconds, options.sensors, options.compression, options.what != "again")
        if options.what == "reexecute":
            execute(folder)
        if options.what == "again":
            again(folder)


if __name__ == "__main__":
    main()
