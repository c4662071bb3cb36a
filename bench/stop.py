"""Measures the emergency stop of a robot at full speed under hostile conditions: `python -m bench.stop [SITUATION]`

The time of a stop is from the start of the program `cocoro stop` until the base commands zero, by the base's
acknowledgement (both on CLOCK_MONOTONIC). The base's state must then be latched and standing.
`python -m bench.stop restarts` stops the robot, kills supervisor, executive and hardware in random order, starts it
again and checks that it is still latched.

Runs as root in separate mount and network namespaces, so that it fills no disk of this machine and stops no other
robot. Exit code 1 when a stop had no effect, was reported wrongly or came later than the bound.
"""

from __future__ import annotations

import argparse
import asyncio
import fcntl
import json
import os
import random
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from bench.ended import leave_when_ended
from bench.stop_rig import NAME, PATIENCE_S, Driver, Place, driving, place
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import FollowedClock
from cocoro.messages import TaskRequest
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import Topic
from deploy.rundir import Target
from services.executive.tasks import FetchTask

STANDING_MPS = 0.01
BOUNDS_S = {"quiet": 0.3, "loaded": 1.0}
"""Bound for the slowest stop, s, by situation; 1.0 for those that are not named."""
COUNTS = {"quiet": 50, "loaded": 50, "restarts": 50}


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
def flood(here: Place, rate_hz: float) -> Iterator[None]:
    """Two processes of the same user that publish garbage on the base's command key."""
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
        print(f"  flooded with {sum(float(rate) for rate in rates if rate):.0f} messages a second")
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


async def measure(here: Place, situation: str, count: int) -> list[Stopped]:
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
                stack.enter_context(flood(here, 100_000.0))
            return [await stop(here, driver, env) for _ in range(count)]


def run(situation: str, count: int, any_time: bool) -> dict[str, Any]:
    bound_s = PATIENCE_S if any_time else BOUNDS_S.get(situation, 1.0)
    with ExitStack() as stack:
        if situation.startswith("shm"):
            stack.enter_context(small_shm("16M" if situation == "shm-16M" else "64M"))
        here = stack.enter_context(place())
        here.up()
        stops = asyncio.run(measure(here, situation, count))
    zero = sorted(one.zero_s for one in stops)
    faults = [fault for one in stops if (fault := one.fault(bound_s))]
    return {
        "situation": situation, "count": count, "median_s": statistics.median(zero), "worst_s": zero[-1],
        "command_median_s": statistics.median(one.ended_s for one in stops),
        "command_worst_s": max(one.ended_s for one in stops),
        "standing_worst_s": max(one.stood_s for one in stops),
        "acknowledged": sum(one.code == 0 for one in stops), "faults": faults,
    }  # fmt: skip


# --- restarts -------------------------------------------------------------------------------------


async def _still_latched(here: Place) -> str:
    """The fault of the latch of a restarted robot; '' when it is latched."""
    async with (
        await ZenohBus.open(here.run_dir.join_as("bench")) as bus,
        Node("tester", bus, FollowedClock(), Robot.load()) as node,
    ):
        states: dict[str, str] = {}
        node.on(topics.BASE_STATE, lambda state: states.update(base=state.latch))
        node.on(topics.ARM_STATE, lambda state: states.update(arm=state.latch))
        node.on(topics.HAND_STATE, lambda state: states.update(hand=state.latch))
        reporting: tuple[Topic[Any], ...] = (topics.BASE_STATE, topics.ARM_STATE, topics.HAND_STATE)
        for topic in reporting:
            await asyncio.wait_for(node.latest(topic).next(), PATIENCE_S)
        await asyncio.sleep(1.5)  # longer than the executive takes to believe a cold start
        reply = await node.call(topics.RUN, TaskRequest(task=FetchTask(label="red_can")), 10.0)
        if reply.accepted or set(states.values()) != {"latched"}:
            return f"{states}, a fetch was {reply.refusal or 'accepted'}"
    return ""


def _kill(here: Place, who: str) -> None:
    file = here.run_dir.path / "supervisor" if who == "supervisor" else here.run_dir.path / "claims" / who
    target = Target(file)
    target.signal(signal.SIGKILL)
    target.wait(10.0)
    target.close()


def restarts(count: int, seed: int) -> list[str]:
    """Kill processes of a stopped robot, `count` times; lists the cases in which the latch was lost, in words."""
    draws = random.Random(seed)
    forgotten = []
    for number in range(count):
        wire = number % 5 == 4
        with place() as here:
            here.up("sim-wire" if wire else "sim", "--frames", "160x120@10")
            code, said = here.run("stop", "--json")
            order = ["supervisor", "executive", "base", *(["arm"] if wire else [])]
            draws.shuffle(order)
            order = order[: draws.randint(1, len(order))]
            for who in order:
                time.sleep(draws.choice((0.0, 0.0, 0.05, 0.3, 1.0)))  # a random moment of the restart
                _kill(here, who)
            if "supervisor" in order:
                here.up("sim-wire" if wire else "sim", "--frames", "160x120@10")
            wrong = asyncio.run(_still_latched(here)) or ("" if code == 0 else said)
        what = f"{'sim-wire' if wire else 'sim'}: killed {', '.join(order)}: {wrong or 'latched'}"
        print(f"  {number + 1:3d} {what}", flush=True)
        if wrong:
            forgotten.append(what)
    return forgotten


# --- the command ----------------------------------------------------------------------------------


def in_namespaces() -> None:
    """Enter new mount and network namespaces."""
    if os.environ.get("BENCH_STOP_INSIDE"):
        subprocess.run(["mount", "--make-rprivate", "/"], check=True)
        return
    command = ["unshare", "--mount", "--net", sys.executable, "-m", "bench.stop", *sys.argv[1:]]
    os.execvpe("unshare", command, os.environ | {"BENCH_STOP_INSIDE": "1"})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("situations", nargs="*", metavar="SITUATION", help=f"{', '.join(SITUATIONS)}, restarts; or all")
    parser.add_argument("--count", type=int, help="stops in each; 50 where it is quiet or loaded, else 20")
    parser.add_argument("--seed", type=int, default=0, help="of the restarts")
    parser.add_argument("--any-time", action="store_true", help="judge the effect and the report, not the time")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    leave_when_ended()
    wanted = options.situations or list(SITUATIONS)
    if unknown := set(wanted) - {*SITUATIONS, "restarts"}:
        parser.error(f"there is no situation {unknown.pop()!r}")
    in_namespaces()
    well = True
    for situation in wanted:
        count = options.count or COUNTS.get(situation, 20)
        if situation == "restarts":
            forgotten = restarts(count, options.seed)
            print(f"restarts: latched {count - len(forgotten)} of {count} times")
            well = well and not forgotten
            continue
        result = run(situation, count, options.any_time)
        well = well and not result["faults"]
        if options.json:
            print(msgspec.json.encode(result).decode())
        else:
            print(
                f"{situation:17s} zero after {result['median_s']:.3f} s in the median, {result['worst_s']:.3f} in the "
                f"worst of {count}; standing after {result['standing_worst_s']:.3f} at most; the command took "
                f"{result['command_median_s']:.3f}, at most {result['command_worst_s']:.3f} s; "
                f"{result['acknowledged']} with exit code 0 ({SITUATIONS[situation]})"
            )
            for fault in result["faults"]:
                print(f"  WRONG: {fault}")
        sys.stdout.flush()
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main())
