"""Measures the emergency stop of a robot at full speed under hostile conditions: `python -m bench stop [SITUATION]`.

The time of a stop is from the start of the program `cocoro stop` until the base commands zero, by the base's
acknowledgement (both on CLOCK_MONOTONIC). The base's state must then be latched and standing. Each stop must have an
effect, be reported truly, and come within the bound.

Runs as root in separate mount and network namespaces, so that it fills no disk of this machine and stops no other
robot.
"""

from __future__ import annotations

import argparse
import asyncio
import fcntl
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from bench.report import Report
from bench.stop_rig import NAME, PATIENCE_S, Driver, Place, driving, in_namespaces, place
from bench.trials import Runs, number_of, one_of, sized
from cocoro import topics

STANDING_MPS = 0.01
BOUNDS_S = {"quiet": 0.3, "loaded": 1.0}
"""Bound for the slowest stop, s, by situation; 1.0 for those that are not named."""
BY_ITSELF = ("shm-full", "shm-16M", "disk-full")
"""Situations that begin before the robot starts, or do not end before it does."""
COUNTS = {"quiet": 50, "loaded": 50}
TRUE = "had an effect, and said so"
"""What each stop must be."""


class Stopped(NamedTuple):
    """The result of one stop."""

    zero_s: float
    """Time from the start of the program until zero was commanded."""
    stood_s: float
    """Time until the base reported that it stands."""
    ended_s: float
    code: int
    said: str

    def fault(self, bound_s: float) -> str:
        if self.zero_s > bound_s:
            return f"zero after {self.zero_s:.2f} s: {self.said}"
        if self.code == 4 or "stopped nothing" in self.said:
            return f"it had an effect and said that it had none: {self.said}"
        return ""


async def stop(here: Place, driver: Driver, env: dict[str, str] | None) -> Stopped:
    await driver.reset()
    driver.latched_s = 0.0
    begun_s = time.monotonic()
    process = here.start("stop", "--json", env=env)
    said = (await asyncio.to_thread(process.communicate))[0].strip()
    ended_s = time.monotonic()
    latched_ns: dict[str, int] = {}
    for line in said.splitlines():
        with suppress(ValueError, AttributeError):
            latched_ns = json.loads(line).get("latched_ns", {})
    await driver.until(lambda state: state.latch == "latched" and abs(state.speed_mps) < STANDING_MPS)
    zero_s = latched_ns["base"] / 1e9 if "base" in latched_ns else driver.latched_s
    return Stopped(zero_s - begun_s, time.monotonic() - begun_s, ended_s - begun_s, process.returncode, said)


# --- situations -----------------------------------------------------------------------------------


def fill(folder: Path) -> None:
    with suppress(OSError), (folder / "filled").open("wb", buffering=0) as file:
        while True:
            file.write(bytes(65536))
    with suppress(OSError), (folder / "filled2").open("wb", buffering=0) as file:
        while True:
            file.write(b"x")


@contextmanager
def small_shm(size: str) -> Iterator[None]:
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", "/dev/shm"], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", "/dev/shm"], check=False)


@contextmanager
def hogs(count: int) -> Iterator[None]:
    processes = [subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


FLOOD = """
import sys, time, zenoh, json
config = zenoh.Config()
for path, value in json.loads(sys.argv[1]).items():
    config.insert_json5(path, json.dumps(value))
session = zenoh.open(config)
publisher = session.declare_publisher(sys.argv[2], congestion_control=zenoh.CongestionControl.DROP)
begun, sent = time.monotonic(), 0
while True:
    for _ in range(1000):
        publisher.put(b"garbage that is not a message")
    sent += 1000
    ahead = sent / float(sys.argv[3]) - (time.monotonic() - begun)
    if ahead > 0:
        time.sleep(ahead)
    if sent % 50000 == 0:
        print(sent / (time.monotonic() - begun), flush=True)
"""


@contextmanager
def flood(here: Place, rate_hz: float, note: Callable[[str], None]) -> Iterator[None]:
    """Two processes of the same user that publish garbage on the base's command key; notes their true rate."""
    sockets = [f"unixsock-stream/{path}" for path in sorted(here.run_dir.path.glob("*.sock"))]
    options = json.dumps(
        {
            "mode": "peer", "scouting/multicast/enabled": False, "scouting/gossip/enabled": False,
            "listen/endpoints": [], "connect/endpoints": sockets, "transport/shared_memory/enabled": False,
        }
    )  # fmt: skip
    key = topics.BASE_COMMAND.key(NAME)
    command = [sys.executable, "-c", FLOOD, options, key, str(rate_hz / 2)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    try:
        rates = [process.stdout.readline() for process in processes if process.stdout]
        yield
        note(f"flooded with {sum(float(rate) for rate in rates if rate):.0f} messages a second")
    finally:
        for process in processes:
            process.kill()
            process.wait()


@contextmanager
def bad_member(here: Place) -> Iterator[None]:
    """A locked register entry with unreadable contents."""
    entry = here.run_dir.path / "ffffffffffffffff.member"
    with entry.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write("{what is this")
        file.flush()
        try:
            yield
        finally:
            entry.unlink(missing_ok=True)


@contextmanager
def idle_connections(here: Place, count: int) -> Iterator[None]:
    with ExitStack() as stack:
        for path in sorted(here.run_dir.path.glob("*.sock")):
            for _ in range(count):
                one = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK))
                with suppress(BlockingIOError, ConnectionError):
                    one.connect(str(path))
        yield


SITUATIONS: dict[str, str] = {
    "quiet": "nothing else runs",
    "loaded": "every processor is saturated by others",
    "shm-full": "/dev/shm of 64 MB, full",
    "shm-16M": "/dev/shm of 16 MB from the start, full",
    "disk-full": "the run directory and the latch's disk are full",
    "bad-member": "a register entry that is locked and corrupt",
    "idle-connections": "120 idle connections to each socket of the mesh",
    "environment": "not one variable in the environment",
    "flood": "100,000 messages a second of rubbish",
}


async def stops_in(here: Place, situation: str, count: int, note: Callable[[str], None]) -> list[Stopped]:
    env: dict[str, str] | None = {} if situation == "environment" else None
    async with driving(here) as driver:
        await driver.reset()
        with ExitStack() as stack:
            if situation == "loaded":
                stack.enter_context(hogs(os.cpu_count() or 1))
            elif situation.startswith("shm"):
                fill(Path("/dev/shm"))
            elif situation == "disk-full":
                fill(here.root / "run")
                fill(here.root / "state")
            elif situation == "bad-member":
                stack.enter_context(bad_member(here))
            elif situation == "idle-connections":
                stack.enter_context(idle_connections(here, 120))
            elif situation == "flood":
                stack.enter_context(flood(here, 100_000.0, note))
            return [await stop(here, driver, env) for _ in range(count)]


# --- the bench ------------------------------------------------------------------------------------


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "situations", nargs="*", type=one_of(SITUATIONS), metavar="SITUATION", help=f"{', '.join(SITUATIONS)}; or all"
    )
    parser.add_argument("--count", type=number_of, help="stops in each; 50 where it is quiet or loaded, else 20")
    parser.add_argument("--one-robot", action="store_true", help="the same robot for all situations that allow it")
    parser.add_argument("--any-time", action="store_true", help="judge the effect and the report, not the time")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    in_namespaces()
    situations = chosen.situations or (["quiet"] if chosen.short else [*SITUATIONS])
    for group in groups(situations) if chosen.one_robot else [[situation] for situation in situations]:
        for situation in group:
            report.say(f"{situation}: {SITUATIONS[situation]}")
        counts = {one: sized(chosen, chosen.count, COUNTS.get(one, 20), 2) for one in group}
        _measure(report, counts, any_time=chosen.any_time)


def groups(situations: Iterable[str]) -> list[list[str]]:
    """The situations that one robot can meet one after the other, and each of the others by itself."""
    together = [situation for situation in situations if situation not in BY_ITSELF]
    return [*([together] if together else []), *([one] for one in situations if one in BY_ITSELF)]


def _measure(report: Report, counts: Mapping[str, int], *, any_time: bool) -> None:
    """One robot in one situation after the other, each with its number of stops."""
    with ExitStack() as stack:
        for situation in counts:
            if situation.startswith("shm"):
                stack.enter_context(small_shm("16M" if situation == "shm-16M" else "64M"))
        here = stack.enter_context(place())
        here.up()
        stops = {one: asyncio.run(stops_in(here, one, count, report.notes.append)) for one, count in counts.items()}
    for situation, of_situation in stops.items():
        _report(report, situation, of_situation, any_time=any_time)


def _report(report: Report, situation: str, stops: Sequence[Stopped], *, any_time: bool) -> None:
    bound_s = BOUNDS_S.get(situation, 1.0)
    runs = Runs(report)
    for one in stops:
        fault = one.fault(PATIENCE_S if any_time else bound_s)
        runs.add(not fault, f"{situation}: {fault or f'zero after {one.zero_s:.3f} s'}")
    runs.share(f"{situation}: {TRUE}")
    zero_s = [one.zero_s for one in stops]
    report.value(f"{situation}: wheels commanded zero after", zero_s, "s")
    report.value(f"{situation}: at the latest", [max(zero_s)], "s", at_most=None if any_time else bound_s)
    report.value(f"{situation}: standing at the latest after", [max(one.stood_s for one in stops)], "s")
    report.value(f"{situation}: the command took", [one.ended_s for one in stops], "s")
    report.share(f"{situation}: ended with exit code 0", sum(one.code == 0 for one in stops), len(stops))
