"""The emergency stop over the mesh: for robots on other machines, and for services that the stop path missed."""

from __future__ import annotations

import asyncio
import sys
import time
from contextlib import suppress
from dataclasses import replace

import msgspec

from apps.cli.stop_result import StopResult
from cocoro.bus.endpoints import ZenohConfig
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import CallTimeoutError, CocoroError, MeshError
from cocoro.keys import alive_key, service_of
from cocoro.messages import EstopReply, EstopRequest
from cocoro.stop.asking import STOPPABLE, movers_first
from cocoro.topics import ESTOP
from deploy.rundir import RunDir, robots

ROUND_S = 0.3
"""Longest wait for answers in one round of requests."""
PAUSE_S = 0.05
"""Pause between two rounds."""
GIVE_UP_S = 3.0
PATIENCE_S = 0.15
"""Longest wait, when joining the mesh, for members that do not answer (a stopped process, for example)."""


def found(robot: str | None, site: str | None) -> list[tuple[RunDir, ZenohConfig]]:
    """The robots to be stopped, and how to reach each. Raises ConfigError for a site that cannot be used."""
    if site is not None:
        from deploy.site import access

        return [(way.run_dir, way.config) for way in access.ways(site, robot, "operator")]
    here = robots() if robot is None else [run_dir for run_dir in (RunDir(robot),) if run_dir.populated]
    return [(run_dir, run_dir.join_as("operator")) for run_dir in here]


def stop_all(which: list[tuple[RunDir, ZenohConfig]], started_s: float) -> tuple[list[StopResult], list[CocoroError]]:
    """Stops the robots concurrently; returns the results, and the errors of those that could not be reached."""

    async def run() -> list[StopResult | BaseException]:
        stops = (stop(run_dir, config, started_s) for run_dir, config in which)
        return await asyncio.gather(*stops, return_exceptions=True)

    stops, errors = [], []
    for (run_dir, _), result in zip(which, asyncio.run(run()), strict=True):
        if isinstance(result, StopResult):
            stops.append(result)
        elif isinstance(result, CocoroError):
            errors.append(type(result)(f"{run_dir.robot}: {result}"))
        else:
            errors.append(MeshError(f"{run_dir.robot}: {type(result).__name__}: {result}"))
    return stops, errors


async def stop(run_dir: RunDir, config: ZenohConfig, started_s: float) -> StopResult:
    """Latches one robot's emergency stop; repeats the request until every running service that moves something has
    acknowledged, or GIVE_UP_S have passed.

    `started_s` is the command's start on the monotonic clock. Raises MeshError when the mesh is not there.
    """
    near = config.directory is not None
    config = replace(config, patience_s=PATIENCE_S if near else config.patience_s)
    async with await ZenohBus.open(config, expect_mesh=True) as bus:
        acknowledged: dict[str, float] = {}
        not_kept: dict[str, str] = {}
        asking_s = time.monotonic()
        waited = False
        while True:
            living, answers = await asyncio.gather(_living(run_dir, bus), _ask(run_dir.robot, bus))
            took_s = time.monotonic() - started_s
            for service, text in answers.items():
                acknowledged.setdefault(service, took_s)
                not_kept[service] = text
            waiting = [service for service in STOPPABLE if service not in acknowledged]
            missing = tuple(service for service in waiting if service in living)
            if not missing or time.monotonic() - asking_s > GIVE_UP_S:
                break
            if not waited:
                print(f"{run_dir.robot}: waiting for {', '.join(missing)}", file=sys.stderr, flush=True)
            waited = True
            await asyncio.sleep(PAUSE_S)
        absent = tuple(service for service in waiting if service not in living)
        took_s = took_s if missing else max(acknowledged.values(), default=took_s)
        why_not_kept = tuple(f"{service}: {text}" for service, text in not_kept.items() if text)
        return StopResult(
            run_dir.robot, tuple(sorted(acknowledged, key=movers_first)), missing, absent, took_s, why_not_kept
        )


async def _ask(robot: str, bus: ZenohBus) -> dict[str, str]:
    """Sends one request to all services; returns those that are latched, each with why its latch is not on the disk."""
    question = msgspec.msgpack.encode(EstopRequest(by="operator"))
    try:
        replies = await bus.call(ESTOP.of("*").key(robot), question, ROUND_S)
    except CallTimeoutError:
        return {}
    latched = {}
    for reply in replies:
        with suppress(msgspec.MsgspecError):
            answer = msgspec.msgpack.decode(reply.payload, type=EstopReply) if reply.ok else None
            if answer is not None and answer.latch == "latched":
                latched[answer.service] = answer.text
    return latched


async def _living(run_dir: RunDir, bus: ZenohBus) -> set[str]:
    """Services that are alive on the mesh, or that a process of this machine has claimed (it may be suspended)."""
    tokens = await bus.alive(alive_key(run_dir.robot), ROUND_S)
    return {service_of(token) for token in tokens} | set(run_dir.claims())
