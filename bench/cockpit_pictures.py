"""What the cockpit costs: processor time for no viewer, one and several, and how old a picture is when it arrives.

A simulated robot stands at its place; its camera delivers 30 pictures a second of 640 x 480. The viewers are WebSocket
clients in processes of their own, which acknowledge each picture; one more measures the age, on the robot's clock.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import subprocess
import sys
import time

import psutil
from websockets.asyncio.client import connect

from bench.cockpit_viewer import header_of
from bench.live import NAME, Operator, operator
from bench.report import Report
from bench.trials import number_of, sized
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import FollowedClock
from cocoro.errors import CocoroError
from cocoro.node import Node
from cocoro.robot import Robot
from deploy.rundir import RunDir

BOUNDS = {1: 8.0, 5: 12.0}
"""Share of a core, %, by viewers."""
SETTLED_S = 3.0
"""Time until the viewers have the best level, before anything is measured."""
OLD_MS = 120.0


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--viewers", type=number_of, action="append", help="how many look; repeatable (1 and 5)")
    parser.add_argument("--count", type=number_of, help="turns of each (3)")
    parser.add_argument("--seconds", type=float, help="of each turn (10)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    count, seconds = sized(chosen, chosen.count, 3, 1), sized(chosen, chosen.seconds, 10.0, 3.0)
    with operator() as cocoro:
        port = started(cocoro)
        pid = RunDir(NAME, cocoro.run_dir.root).claimant_pid("cockpit")
        process = psutil.Process(pid)
        report.value("a core for the cockpit, nobody looks", [_share(process, seconds) for _ in range(count)], "%")
        for viewers in chosen.viewers or (1, 5):
            _look(process, port, viewers, count, seconds, report)
        ages = asyncio.run(_ages(cocoro, port, count * seconds))
        report.value("from the picture's stamp to its arrival", ages, "ms", at_most=OLD_MS)


def started(cocoro: Operator, *arguments: str) -> int:
    """Start the robot; returns the port of its cockpit. Raises CocoroError when it does not start."""
    code, said, _ = cocoro("up", "sim", "--detach", "--set", "service.cockpit.port=0", *arguments)
    found = re.search(r"cockpit: http://127\.0\.0\.1:(\d+)/", said)
    if code or found is None:
        raise CocoroError(f"the robot with a cockpit did not start: {said}")
    return int(found[1])


def _look(process: psutil.Process, port: int, viewers: int, count: int, seconds: float, report: Report) -> None:
    shares, rates, sizes = list[float](), list[float](), list[float]()
    for _ in range(count):
        argv = [sys.executable, "-m", "bench.cockpit_viewer", str(port), str(SETTLED_S + seconds + 1.0)]
        clients = [subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) for _ in range(viewers)]
        for client in clients:
            assert client.stdout is not None
            client.stdout.readline()
        time.sleep(SETTLED_S)
        shares.append(_share(process, seconds))
        for client in clients:
            told = json.loads(client.communicate(timeout=60.0)[0])
            rates.append(told["pictures"] / told["seconds"])
            sizes.append(told["bytes"] / told["seconds"] / 1e3)
    who = "one viewer" if viewers == 1 else f"{viewers} viewers"
    report.value(f"a core for the cockpit, {who}", shares, "%", at_most=BOUNDS.get(viewers))
    report.value(f"pictures a second, {who}", rates, "Hz")
    report.value(f"sent to each, {who}", sizes, "kB/s")


def _share(process: psutil.Process, seconds: float) -> float:
    """Processor time of a process over so long, % of a core."""
    before_s, begun_s = sum(process.cpu_times()[:2]), time.monotonic()
    time.sleep(seconds)
    return 100.0 * (sum(process.cpu_times()[:2]) - before_s) / (time.monotonic() - begun_s)


async def _ages(cocoro: Operator, port: int, seconds: float) -> list[float]:
    """The ages of pictures at their arrival, ms, by the robot's clock."""
    found: list[float] = []
    async with (
        await ZenohBus.open(cocoro.run_dir.join_as("bench"), expect_mesh=True) as bus,
        Node("bench", bus, FollowedClock(), Robot.load(), robot_name=NAME) as node,
        connect(f"ws://127.0.0.1:{port}/live", compression=None, max_size=None) as socket,
    ):
        await node.clock.wait_started()
        until_s = time.monotonic() + SETTLED_S + seconds
        while time.monotonic() < until_s:
            message = await socket.recv()
            if isinstance(message, bytes):
                now_ns, stamp_ns = node.now_ns(), header_of(message)["stamp_ns"]
                await socket.send(json.dumps({"do": "seen", "stamp_ns": stamp_ns}))
                if time.monotonic() > until_s - seconds:
                    found.append((now_ns - stamp_ns) / 1e6)
    return found
