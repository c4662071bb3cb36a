"""`cocoro estop`, in short `stop`: from Enter to wheels halted in under half a second.

So nothing is imported here that it can do without: no command line library, no numbers library, no node.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
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
PAUSE_S = 0.05
GIVE_UP_S = 3.0
PATIENCE_S = 0.15
"""How long joining the mesh waits for members that do not answer (a stopped process, say)."""


class Stop(NamedTuple):
    """How stopping one robot went."""

    robot: str
    acknowledged: tuple[str, ...]
    missing: tuple[str, ...]
    """Known to run, and did not acknowledge."""
    absent: tuple[str, ...]
    """Nobody there to acknowledge."""
    seconds: float
    """From Enter to the last acknowledgement."""

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
    started_s = _process_start_s()
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


def _process_start_s() -> float:
    """When this process was started, on the monotonic clock: the operator's Enter, to 10 ms (proc_pid_stat(5))."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):  # not Linux
        age_s = 0.0
    return time.monotonic() - age_s


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
    def say(result: Stop) -> None:
        text = json.dumps(result._asdict()) if as_json else str(result)
        print(text, file=sys.stderr if result.code and not as_json else sys.stdout, flush=True)

    stops = (stop(run_dir, config, started_s, say) for run_dir, config in found)
    results = await asyncio.gather(*stops, return_exceptions=True)
    code = exits.DONE
    for (run_dir, _), result in zip(found, results, strict=True):
        if isinstance(result, Stop):
            code = code or result.code
        elif isinstance(result, CocoroError):
            print(f"cocoro: {run_dir.robot}: {result}", file=sys.stderr)
            code = code or (exits.NO_MESH if isinstance(result, MeshError) else exits.FAILED)
        else:
            raise result
    return code


async def stop(run_dir: RunDir, config: ZenohConfig, started_s: float, say: Callable[[Stop], None]) -> Stop:
    """Latch one robot's emergency stop: ask again and again until all who run and move have acknowledged.

    `say` gets the result at once; leaving the mesh may take a while. Raises MeshError when that is not there.
    """
    async with await ZenohBus.open(replace(config, patience_s=PATIENCE_S), expect_mesh=True) as bus:
        acknowledged: dict[str, float] = {}
        waited = False
        while True:
            living, answers = await asyncio.gather(_living(run_dir, bus), _ask(run_dir.robot, bus))
            took_s = time.monotonic() - started_s
            for service in answers:
                acknowledged.setdefault(service, took_s)
            waiting = [service for service in STOPPABLE if service not in acknowledged]
            missing = tuple(service for service in waiting if service in living)
            if not missing or took_s > GIVE_UP_S:
                break
            if not waited:
                print(f"{run_dir.robot}: waiting for {', '.join(missing)}", file=sys.stderr, flush=True)
            waited = True
            await asyncio.sleep(PAUSE_S)
        absent = tuple(service for service in waiting if service not in living)
        took_s = took_s if missing else max(acknowledged.values(), default=took_s)
        result = Stop(run_dir.robot, tuple(acknowledged), missing, absent, took_s)
        say(result)
        return result


async def _ask(robot: str, bus: ZenohBus) -> list[str]:
    """Ask everybody once; the services that say they are latched."""
    question = msgspec.msgpack.encode(EstopRequest(latched=True, by="operator"))
    try:
        replies = await bus.call(ESTOP.of("*").key(robot), question, ROUND_S)
    except CallTimeoutError:
        return []
    latched = []
    for reply in replies:
        with suppress(msgspec.MsgspecError):
            answer = msgspec.msgpack.decode(reply.payload, type=EstopReply) if reply.ok else None
            if answer is not None and answer.latch == "latched":
                latched.append(answer.service)
    return latched


async def _living(run_dir: RunDir, bus: ZenohBus) -> set[str]:
    """The services that are alive on the mesh, and those that a process here is, though it may have been stopped."""
    tokens = await bus.alive(f"{run_dir.robot}/*/alive", ROUND_S)
    return {token.split("/")[1] for token in tokens} | set(run_dir.claims())
