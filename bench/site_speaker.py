"""One end of the commands that `bench.site_latency` times: `python -m bench.site_speaker ROLE OPTIONS`.

Role `brain` publishes wheel commands, role `body` hears them; by a Node on its host's private mesh, from where gateways
pass them on; by raw zenoh over TLS, straight to the other end; and by raw zenoh over a router on each host, as the
gateways are, but without rules, limits and logs. Prints the times on the way as JSON. Roles `router-brain` and
`router-body` are those routers. `OPTIONS` is one JSON object.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import zenoh
from zenoh.handlers import Callback

from bench.mesh_process import stamp, stamped
from cocoro.bus.base import Qos
from cocoro.bus.declared import QOS
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import RealClock, steady_ns
from cocoro.lending import LendingLoop
from cocoro.messages import BaseCommand
from cocoro.node import Node
from cocoro.publisher import encode
from cocoro.robot import Robot
from cocoro.topics import BASE_COMMAND
from deploy.rundir import RunDir
from deploy.site import credentials

SETTLE_S = 2.0
"""From the beginning until the first message, and from the last one to the end."""
RAW = "raw/command"
HZ = 50.0
NODE, DIRECT, ROUTED = "node", "direct", "routed"
"""The ways: Node to Node over gateways; raw zenoh straight; raw zenoh over bare routers."""
WAYS = 3
ROUTER = "router-"


def session(mode: str, options: dict[str, Any], listen: list[str], connect: list[str]) -> zenoh.Session:
    """A session that meets these ends, and nobody else, with the credentials of its host."""
    config = zenoh.Config()
    mine = credentials.read(Path(options["credentials"]), datetime.now(UTC))
    chosen = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        **mine.options,
    }
    for path, value in chosen.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def socket_of(options: dict[str, Any]) -> str:
    """The end of this host's bare router for the programs on it."""
    return f"unixsock-stream/{options['run']}/bare-router"


async def route(host: str, options: dict[str, Any]) -> None:
    """A bare router of one host."""
    listen, connect = ([options["bare"]], []) if host == "body" else ([], [options["bare"]])
    router = session("router", options, [socket_of(options), *listen], connect)
    await asyncio.sleep(options["seconds"] + 4 * SETTLE_S)
    router.close()  # type: ignore[no-untyped-call]


async def speak(role: str, options: dict[str, Any]) -> dict[str, list[int]]:
    """Sends and hears for the given times; returns the ns on the way, by way."""
    took: dict[str, list[int]] = {name: [] for name in (NODE, DIRECT, ROUTED)}
    clock = RealClock(0)
    there = [options["raw"]]
    direct = session("peer", options, *((there, []) if role == "body" else ([], there)))
    routed = session("client", options, [], [socket_of(options)])
    raw = {DIRECT: direct, ROUTED: routed}
    run_dir = RunDir(options["robot"], Path(options["run"]))
    async with (
        await ZenohBus.open(run_dir.join_as(f"speaker-{role}")) as bus,
        Node(
            "planning" if role == "brain" else "kinect", bus, clock, Robot.load(), robot_name=options["robot"]
        ) as node,
    ):

        def on_raw(way: str) -> Any:
            return lambda sample: took[way].append(steady_ns() - stamp(sample.payload.to_bytes()))

        if role == "body":
            node.on(BASE_COMMAND, lambda message: took[NODE].append(clock.now_ns() - message.stamp_ns))
            heard = [each.declare_subscriber(RAW, Callback(on_raw(way), indirect=False)) for way, each in raw.items()]
            await asyncio.sleep(options["seconds"] + 2 * SETTLE_S)
            for one in heard:
                one.undeclare()  # type: ignore[no-untyped-call]
        else:
            commands = node.publisher(BASE_COMMAND)
            publishers = [each.declare_publisher(RAW, **QOS[Qos.COMMAND]) for each in raw.values()]
            # As many bytes as the node's message has.
            size = bytes(len(encode(BaseCommand(ahead_mps=0.1, turn_radps=0.0, stamp_ns=1 << 60, seq=1 << 15))))
            await asyncio.sleep(SETTLE_S)
            begun_s = time.monotonic()
            for number in range(WAYS * options["commands"]):  # in turns, a third of a period apart
                await asyncio.sleep(max(0.0, begun_s + number / (WAYS * HZ) - time.monotonic()))
                way = number % WAYS
                if way == len(publishers):
                    commands.put(BaseCommand(ahead_mps=0.1, turn_radps=0.0))
                else:
                    publishers[way].put(stamped(size))
            await asyncio.sleep(SETTLE_S)
    for each in raw.values():
        each.close()  # type: ignore[no-untyped-call]
    return took


def main() -> None:
    role, options = sys.argv[1], json.loads(sys.argv[2])
    with asyncio.Runner(loop_factory=LendingLoop) as runner:
        if role.startswith(ROUTER):
            runner.run(route(role.removeprefix(ROUTER), options))
            return
        print(json.dumps(runner.run(speak(role, options))), flush=True)


if __name__ == "__main__":
    main()
