"""`cocoro estop`, in short `stop`: from Enter to wheels halted in under half a second.

So nothing is imported here that it can do without: no command line library, no numbers library, no node.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import time
from dataclasses import replace
from typing import NamedTuple

import msgspec

from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.zenoh import ZenohBus
from cocoro.cli import exits
from cocoro.errors import CallTimeoutError, CocoroError, ConfigError, MeshError
from cocoro.messages import EstopReply, EstopRequest
from cocoro.rundir import RunDir, robots
from cocoro.topics import ESTOP, STOPPABLE

ROUND_S = 0.3
"""How long one round of asking waits for those that do not answer."""
GIVE_UP_S = 3.0
PATIENCE_S = 0.15
"""How long joining the mesh waits for members that do not answer (a stopped process, say)."""


class Stop(NamedTuple):
    """How stopping one robot went."""

    robot: str
    acknowledged: tuple[str, ...]
    missing: tuple[str, ...]
    """Alive, and did not acknowledge."""
    absent: tuple[str, ...]
    """Not alive: nobody there to acknowledge."""
    seconds: float

    @property
    def code(self) -> int:
        if self.missing:
            return exits.FAILED
        return exits.DONE if any(service in STOPPABLE for service in self.acknowledged) else exits.NO_MESH

    def __str__(self) -> str:
        text = f"{self.robot}: stopped {', '.join(self.acknowledged) or 'nothing'} in {self.seconds:.2f} s"
        if self.missing:
            text += f"; NOT ACKNOWLEDGED by {', '.join(self.missing)}"
        if self.absent:
            text += f"; not there: {', '.join(self.absent)}"
        return text


def main(command: str, arguments: list[str]) -> int:
    started_s = time.monotonic()
    parser = argparse.ArgumentParser(
        prog=f"cocoro {command}",
        description="Latch the emergency stop: wheels, arm and hand hold still until `cocoro reset`. "
        "Without --robot and --profile every robot that is up on this machine is stopped.",
        epilog="Exit code 0 when every service that moves something has acknowledged, 1 when one has not "
        "(it is named), 4 when no robot is there.",
    )
    parser.add_argument("--robot", metavar="NAME")
    parser.add_argument("--profile", metavar="FILE", help="reach the robot as this profile says, on another machine")
    parser.add_argument("--json", action="store_true", help="print one JSON object a robot")
    try:
        options = parser.parse_args(arguments)
        found = _robots(options.robot, options.profile)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else exits.USAGE
    except ConfigError as error:
        print(f"cocoro: {error}", file=sys.stderr)
        return exits.USAGE
    if not found:
        which = "no robot" if options.robot is None else f"no {options.robot}"
        print(f"cocoro: {which} is up on this machine: start one with `cocoro up sim`", file=sys.stderr)
        return exits.NO_MESH
    return asyncio.run(_stop_all(found, started_s, options.json))


def _robots(robot: str | None, profile: str | None) -> list[tuple[RunDir, ZenohConfig]]:
    """Those to be stopped, and how to reach each."""
    if profile is not None:
        from cocoro import profiles

        said = profiles.read(profile)
        run_dir = RunDir(robot or said.robot)
        return [(run_dir, run_dir.join_as("operator", said.mesh))]
    here = robots() if robot is None else [run_dir for run_dir in (RunDir(robot),) if run_dir.populated]
    return [(run_dir, run_dir.join_as("operator")) for run_dir in here]


async def _stop_all(found: list[tuple[RunDir, ZenohConfig]], started_s: float, as_json: bool) -> int:
    stops = (stop(run_dir.robot, config, started_s) for run_dir, config in found)
    results = await asyncio.gather(*stops, return_exceptions=True)
    code = exits.DONE
    for (run_dir, _), result in zip(found, results, strict=True):
        if isinstance(result, Stop):
            if as_json:
                print(json.dumps(result._asdict()))
            else:
                print(result, file=sys.stderr if result.code else sys.stdout)
            code = code or result.code
        elif isinstance(result, CocoroError):
            print(f"cocoro: {run_dir.robot}: {result}", file=sys.stderr)
            code = code or (exits.NO_MESH if isinstance(result, MeshError) else exits.FAILED)
        else:
            raise result
    return code


async def stop(robot: str, config: ZenohConfig, started_s: float) -> Stop:
    """Latch one robot's emergency stop: ask again and again until all who live and move have acknowledged.

    Raises MeshError when its mesh is not there.
    """
    key = ESTOP.of("*").key(robot)
    question = msgspec.msgpack.encode(EstopRequest(latched=True, by="operator"))
    decoder = msgspec.msgpack.Decoder(EstopReply)
    acknowledged: dict[str, float] = {}
    async with await ZenohBus.open(replace(config, patience_s=PATIENCE_S), expect_mesh=True) as bus:
        while True:
            alive = asyncio.ensure_future(bus.alive(f"{robot}/*/alive", ROUND_S))
            try:
                replies = await bus.call(key, question, ROUND_S)
            except CallTimeoutError:
                replies = []
            for reply in replies:
                try:
                    answer = decoder.decode(reply.payload) if reply.ok else None
                except msgspec.MsgspecError:
                    answer = None
                if answer is not None and answer.latch == "latched":
                    acknowledged.setdefault(answer.service, time.monotonic() - started_s)
            living = {token.split("/")[1] for token in await alive}
            missing = tuple(s for s in STOPPABLE if s in living and s not in acknowledged)
            took_s = time.monotonic() - started_s
            if not missing or took_s > GIVE_UP_S:
                absent = tuple(s for s in STOPPABLE if s not in living and s not in acknowledged)
                took_s = max(acknowledged.values(), default=took_s) if not missing else took_s
                return Stop(robot, tuple(acknowledged), missing, absent, took_s)
