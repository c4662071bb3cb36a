"""Measures the mesh over Unix sockets, tcp and routers: latencies, the CPU share of a camera, and the time to join.

`python -m bench mesh` compares the way that a robot uses with other middleware. The figures depend on this machine and
its load; compare within the table. Each ratio is to the first row.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

from bench.report import Report, Table
from cocoro.bus.base import Payload, Qos
from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.zenoh import ZenohBus

PING = bytes(1024)
FRAME = os.urandom(640 * 480 * 5)
RATE_HZ = 30.0


@dataclass(frozen=True)
class Way:
    """A configuration of the mesh: how a process named `name` joins."""

    title: str
    directory: str | None = None
    ports: tuple[int, ...] = ()
    router: bool = False
    shared_memory: bool = True
    receiver_too: bool = True
    """Whether the receiver of the frames uses shared memory, too."""

    def config(self, name: str) -> ZenohConfig:
        if self.directory is not None:
            shares = self.shared_memory and (self.receiver_too or name != "bench")
            return ZenohConfig(name, directory=Path(self.directory), shared_memory=shares)
        endpoints = [f"tcp/127.0.0.1:{port}" for port in self.ports]
        if self.router and name == "router":
            return ZenohConfig(name, mode="router", listen=(endpoints[0],), shared_memory=self.shared_memory)
        if self.router:
            return ZenohConfig(name, mode="client", connect=(endpoints[0],), shared_memory=self.shared_memory)
        place = {"bench": 0, "other": 1}.get(name, 2)  # the later one connects
        listen = endpoints[place] if place < 2 else "tcp/127.0.0.1:0"
        return ZenohConfig(name, listen=(listen,), connect=tuple(endpoints[:place]), shared_memory=self.shared_memory)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


# The other process


async def serve(way: Way, name: str) -> None:
    """Echo pings, answer calls and send frames on request, or only route, until standard input ends."""
    ended = asyncio.Event()

    def end() -> None:
        if not os.read(sys.stdin.fileno(), 1):
            ended.set()

    asyncio.get_running_loop().add_reader(sys.stdin.fileno(), end)
    async with await ZenohBus.open(way.config(name)) as bus:
        if name == "router":
            await ended.wait()
            return
        pong = bus.publisher("bench/pong", Qos.COMMAND)
        frames = bus.publisher("bench/frame", Qos.FRAME)
        bus.subscribe("bench/ping", Qos.COMMAND, lambda _, payload: pong.put(payload), depth=1)

        async def answer(_: str, payload: Payload) -> bytes:
            return bytes(payload)

        async def send(_: str, payload: Payload) -> bytes:
            seconds = float(bytes(payload))
            begin_s, cpu_s = time.monotonic(), time.process_time()
            puts_ms = []
            for number in range(round(seconds * RATE_HZ)):
                put_s = time.monotonic()
                frames.put(time.monotonic_ns().to_bytes(8, "little") + FRAME)
                puts_ms.append((time.monotonic() - put_s) * 1e3)
                await asyncio.sleep(max(0.0, begin_s + (number + 1) / RATE_HZ - time.monotonic()))
            share = (time.process_time() - cpu_s) / (time.monotonic() - begin_s)
            return json.dumps({"cpu_share": share, "put_ms": statistics.median(puts_ms)}).encode()

        bus.serve("bench/call", answer)
        bus.serve("bench/send", send)
        bus.declare_alive(f"bench/{name}/alive")
        await ended.wait()


@asynccontextmanager
async def process(way: Way, name: str) -> AsyncIterator[None]:
    arguments = json.dumps([way.title, way.directory, way.ports, way.router, way.shared_memory, way.receiver_too])
    started = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "bench.bus", "--serve", arguments, name, stdin=subprocess.PIPE
    )
    try:
        yield
    finally:
        assert started.stdin is not None
        started.stdin.close()
        await started.wait()


async def alive(bus: ZenohBus, key: str) -> None:
    there = asyncio.Event()
    watch = bus.watch_alive(key, lambda _, alive: there.set() if alive else None)
    await there.wait()
    watch.close()


# The measurements


async def pings_us(bus: ZenohBus, count: int) -> list[float]:
    """Half the round-trip time of 1 KiB, from event loop to event loop."""
    came = asyncio.Event()
    subscription = bus.subscribe("bench/pong", Qos.COMMAND, lambda *_: came.set(), depth=1)
    ping = bus.publisher("bench/ping", Qos.COMMAND)
    await bus.call("bench/call", b"", 5.0)
    halves = []
    for _ in range(count):
        came.clear()
        begin_s = time.perf_counter()
        ping.put(PING)
        try:
            await asyncio.wait_for(came.wait(), 1.0)
        except TimeoutError:
            continue  # the other process does not know it yet
        halves.append((time.perf_counter() - begin_s) * 1e6 / 2)
    subscription.close()
    ping.close()
    return halves[count // 10 :]


async def calls_us(bus: ZenohBus, count: int) -> list[float]:
    took = []
    for _ in range(count):
        begin_s = time.perf_counter()
        await bus.call("bench/call", PING, 5.0)
        took.append((time.perf_counter() - begin_s) * 1e6)
    return took[count // 10 :]


async def frames_ms(bus: ZenohBus, seconds: float) -> tuple[list[float], float, float, float, int]:
    """One-way times until the bytes have arrived, CPU shares of sender and receiver, the median time of a put, and
    the number of arrivals."""
    took: list[float] = []

    def arrive(_: str, payload: Payload) -> None:
        took.append((time.monotonic_ns() - int.from_bytes(payload[:8], "little")) / 1e6)

    subscription = bus.subscribe("bench/frame", Qos.FRAME, arrive, depth=1)
    begin_s, cpu_s = time.monotonic(), time.process_time()
    (reply,) = await bus.call("bench/send", f"{seconds}".encode(), seconds + 5.0)
    share = (time.process_time() - cpu_s) / (time.monotonic() - begin_s)
    sender = json.loads(reply.payload)
    subscription.close()
    return took[3:], sender["cpu_share"], share, sender["put_ms"], len(took)


async def joining_ms(way: Way, count: int) -> list[float]:
    took = []
    for number in range(count):
        begin_s = time.perf_counter()
        async with await ZenohBus.open(way.config(f"late{number}"), expect_mesh=True) as bus:
            assert len(await bus.call("bench/call", b"", 5.0)) >= 1
            took.append((time.perf_counter() - begin_s) * 1e3)
    return took


def p99(values: list[float]) -> float:
    return statistics.quantiles(values, n=100)[98]


async def measure_way(way: Way, pings: int, seconds: float, quick: bool = False) -> dict[str, float]:
    row: dict[str, float] = {}
    async with (
        process(way, "router") if way.router else nothing(),
        await patiently(way.config("bench")) as bus,
        process(way, "other"),
    ):
        await alive(bus, "bench/other/alive")
        if not quick:
            halves, calls = await pings_us(bus, pings), await calls_us(bus, pings)
            row |= {"ping_us": statistics.median(halves), "ping_p99_us": p99(halves)}
            row |= {"call_us": statistics.median(calls)}
        took, sender, receiver, put_ms, arrived = await frames_ms(bus, seconds)
        row |= {"frame_ms": statistics.median(took), "frame_p99_ms": p99(took), "put_ms": put_ms}
        row |= {"sender_cpu": sender, "receiver_cpu": receiver, "arrived": arrived / round(seconds * RATE_HZ)}
        if not quick:
            row |= {"join_ms": statistics.median(await joining_ms(way, 20))}
    return row


async def patiently(config: ZenohConfig) -> ZenohBus:
    """Open a session; waits for the router."""
    while True:
        try:
            return await ZenohBus.open(config)
        except Exception as error:
            print(f"  waiting: {error}", file=sys.stderr)


@asynccontextmanager
async def nothing() -> AsyncIterator[None]:
    yield


async def program_ms(directory: str, members: int, count: int = 10) -> list[float]:
    """Time from the start of a Python program to the end of its first call, by the number of members."""
    script = (
        "import asyncio, sys; from pathlib import Path\n"
        "from cocoro.bus.endpoints import ZenohConfig; from cocoro.bus.zenoh import ZenohBus\n"
        "async def main():\n"
        "    bus = await ZenohBus.open(ZenohConfig('cli', directory=Path(sys.argv[1])), expect_mesh=True)\n"
        "    assert len(await bus.call('bench/call', b'', 1.0)) == int(sys.argv[2])\n"
        "    await bus.close()\n"
        "asyncio.run(main())"
    )
    way, took = Way("", directory=directory), []
    async with await ZenohBus.open(way.config("bench")) as bus:
        others = [process(way, f"member{number}") for number in range(members)]
        for other in others:
            await other.__aenter__()
        for number in range(members):
            await alive(bus, f"bench/member{number}/alive")
        for _ in range(count):
            begin_s = time.perf_counter()
            program = await asyncio.create_subprocess_exec(sys.executable, "-c", script, directory, str(members))
            assert await program.wait() == 0
            took.append((time.perf_counter() - begin_s) * 1e3)
        for other in others:
            await other.__aexit__(None, None, None)
    return took


COLUMNS = {
    "ping_us": ("RTT/2, us", "{:.0f}"),
    "ping_p99_us": ("p99", "{:.0f}"),
    "call_us": ("call, us", "{:.0f}"),
    "frame_ms": ("frame, ms", "{:.2f}"),
    "frame_p99_ms": ("p99", "{:.2f}"),
    "put_ms": ("put, ms", "{:.2f}"),
    "sender_cpu": ("CPU out", "{:.1%}"),
    "receiver_cpu": ("CPU in", "{:.1%}"),
    "arrived": ("arrived", "{:.0%}"),
    "join_ms": ("join+call, ms", "{:.1f}"),
}


def table(rows: dict[str, dict[str, float]]) -> Table:
    first, made = next(iter(rows.values())), []
    for title, row in rows.items():
        cells = [title]
        for name, (_, form) in COLUMNS.items():
            cell = form.format(row[name]) if name in row else "-"
            if row is not first and name in row and first[name] > 0:
                cell += f" x{row[name] / first[name]:.1f}"
            cells.append(cell)
        made.append(cells)
    return Table("Ways into the mesh", ["way", *(heading for heading, _ in COLUMNS.values())], made)


async def _measure(pings: int, seconds: float, report: Report) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        ways = [
            Way("peers, Unix sockets", directory=f"{temporary}/a"),
            Way("the same, no shared memory", directory=f"{temporary}/b", shared_memory=False),
            Way("the same, the receiver without", directory=f"{temporary}/c", receiver_too=False),
            Way("peers, tcp", ports=(free_port(), free_port())),
            Way("clients of a router, tcp", ports=(free_port(),), router=True),
            Way("the same, no shared memory", ports=(free_port(),), router=True, shared_memory=False),
        ]
        rows = {}
        for way in ways:
            title = f"{way.title} ({'router' if way.router else 'peers'})" if way.title in rows else way.title
            rows[title] = await measure_way(way, pings, seconds)
            report.say(f"{title}: measured")
        report.tables.append(table(rows))
        for members in (1, 8):
            took = await program_ms(f"{temporary}/m{members}", members)
            report.value(f"a program from start to end, with one call in a mesh of {members} others", took, "ms")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--pings", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=6.0, help="of the camera's stream, for each row (6)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    pings, seconds = (200, 1.0) if chosen.short else (chosen.pings, chosen.seconds)
    asyncio.run(_measure(pings, seconds, report))


if __name__ == "__main__":  # the other process
    asyncio.run(serve(Way(*json.loads(sys.argv[2])), sys.argv[3]))
