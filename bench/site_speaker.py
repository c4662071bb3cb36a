"""One end of the commands that `bench.site_latency` times: `python -m bench.site_speaker ROLE OPTIONS`.

Role `brain` publishes wheel commands, role `body` hears them; by a Node on its host's private mesh, from where gateways
pass them on, and by raw zenoh over TLS, straight to the other end. `OPTIONS` is one JSON object. Prints the times on
the way as JSON.
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


def raw_session(role: str, options: dict[str, Any]) -> zenoh.Session:
    """A session that meets the other end's over TLS, and nobody else."""
    config = zenoh.Config()
    mine = credentials.read(Path(options["credentials"]), datetime.now(UTC))
    at = {"listen/endpoints" if role == "body" else "connect/endpoints": [options["raw"]]}
    chosen = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
    }
    for path, value in {**chosen, "listen/endpoints": [], **at, **mine.options}.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


async def speak(role: str, options: dict[str, Any]) -> dict[str, list[int]]:
    """Sends and hears for the given times; returns the ns on the way, by way and message."""
    took: dict[str, list[int]] = {name: [] for name in ("node command", "raw command")}
    clock = RealClock(0)
    raw = raw_session(role, options)
    run_dir = RunDir(options["robot"], Path(options["run"]))
    async with (
        await ZenohBus.open(run_dir.join_as(f"speaker-{role}")) as bus,
        Node(
            "planning" if role == "brain" else "kinect", bus, clock, Robot.load(), robot_name=options["robot"]
        ) as node,
    ):

        def on_raw(sample: zenoh.Sample) -> None:
            took["raw command"].append(steady_ns() - stamp(sample.payload.to_bytes()))

        if role == "body":
            node.on(BASE_COMMAND, lambda message: took["node command"].append(clock.now_ns() - message.stamp_ns))
            heard = raw.declare_subscriber(RAW, Callback(on_raw, indirect=False))
            await asyncio.sleep(options["seconds"] + 2 * SETTLE_S)
            heard.undeclare()  # type: ignore[no-untyped-call]
        else:
            commands = node.publisher(BASE_COMMAND)
            raw_commands = raw.declare_publisher(RAW, **QOS[Qos.COMMAND])
            # As many bytes as the node's message has.
            size = bytes(len(encode(BaseCommand(left_mps=0.1, right_mps=0.1, stamp_ns=1 << 60, seq=1 << 15))))
            await asyncio.sleep(SETTLE_S)
            begun_s = time.monotonic()
            for number in range(2 * options["commands"]):  # in turns, half a period apart
                await asyncio.sleep(max(0.0, begun_s + number / (2 * HZ) - time.monotonic()))
                if number % 2:
                    commands.put(BaseCommand(left_mps=0.1, right_mps=0.1))
                else:
                    raw_commands.put(stamped(size))
            await asyncio.sleep(SETTLE_S)
    raw.close()  # type: ignore[no-untyped-call]
    return took


def main() -> None:
    role, options = sys.argv[1], json.loads(sys.argv[2])
    with asyncio.Runner(loop_factory=LendingLoop) as runner:
        print(json.dumps(runner.run(speak(role, options))), flush=True)


if __name__ == "__main__":
    main()
