"""The emergency stop and its release over a robot's mesh."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from cocoro.errors import CocoroError, MeshError, RefusedError
from cocoro.messages import EstopReply, EstopRequest, ResetRequest
from cocoro.participant import Answer, Participant
from cocoro.topics import ANY, ESTOP, RESET
from deploy.processes import stoppable

ROUND_S = 0.3
"""Longest wait for answers in one round of requests."""
PAUSE_S = 0.05
GIVE_UP_S = 3.0
EXECUTIVE = "executive"

StopPath = Callable[[], frozenset[str]]
"""Stops the robot on this machine by the stop path, and returns the services that have acknowledged."""


class Stopped(NamedTuple):
    """Everything that moves stands still until the release."""

    acknowledged: tuple[str, ...]
    """The services that are latched."""
    absent: tuple[str, ...]
    """Services that move something and do not run."""


class Released(NamedTuple):
    services: tuple[str, ...]
    """The services that move something and are released."""
    notes: tuple[str, ...]
    """What they said beside that."""


class NotStoppedError(CocoroError):
    """A service that moves something has not acknowledged the emergency stop."""

    def __init__(self, acknowledged: tuple[str, ...], missing: tuple[str, ...]) -> None:
        super().__init__(f"the emergency stop is NOT ACKNOWLEDGED by {', '.join(missing)}: use the robot's own switch")
        self.acknowledged = acknowledged
        self.missing = missing


class NotReleasedError(RefusedError):
    """A service does not release the emergency stop. When the executive refuses, everything stays latched."""

    def __init__(self, reasons: tuple[str, ...]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons
        """One for each such service."""


async def stop(participant: Participant, by: str, path: StopPath | None = None) -> Stopped:
    """Latches the emergency stop, by the stop path of this machine, too, where there is one; asks again until every
    service that moves something has acknowledged. Raises NotStoppedError when one has not within GIVE_UP_S, MeshError
    when nothing that moves is there."""
    beside = None if path is None else asyncio.ensure_future(asyncio.to_thread(path))
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    latched: set[str] = set()
    while True:
        answers, alive = await asyncio.gather(
            participant.call_all(ESTOP.of(ANY), EstopRequest(by=by), ROUND_S), participant.alive()
        )
        latched |= {one.service for one in answers if one.reply is not None and one.reply.latch == "latched"}
        if beside is not None and beside.done():
            with suppress(OSError):  # the stop path cannot be used here
                latched |= beside.result()
        missing = tuple(name for name in stoppable() if name in alive and name not in latched)
        if not missing or loop.time() - begun_s > GIVE_UP_S:
            break
        await asyncio.sleep(PAUSE_S)
    if beside is not None:
        with suppress(OSError):
            latched |= await beside
    missing = tuple(name for name in missing if name not in latched)
    if missing:
        raise NotStoppedError(tuple(sorted(latched)), missing)
    if not latched & {*stoppable()}:
        raise MeshError(f"no service that moves something is alive on {participant.robot_name}: see `cocoro status`")
    return Stopped(tuple(sorted(latched)), tuple(name for name in stoppable() if name not in latched))


async def release(participant: Participant, by: str) -> Released:
    """Releases a robot's latches. The executive is asked first: when it refuses, everything stays latched. Raises
    MeshError when nothing that moves is alive, NotReleasedError."""
    question = ResetRequest(by=by)
    alive = await participant.alive()
    moving = {service for service in stoppable() if service in alive}
    if not moving:
        raise MeshError(f"no service that moves something is alive on {participant.robot_name}: see `cocoro status`")
    if EXECUTIVE in alive:
        _check({EXECUTIVE}, await participant.call_all(RESET.of(EXECUTIVE), question))
    answers = await participant.call_all(RESET.of(ANY), question)
    _check(moving, answers)
    notes = (f"{one.service}: {one.reply.text}" for one in answers if one.reply is not None and one.reply.text)
    return Released(tuple(sorted(moving)), tuple(notes))


def _check(wanted: set[str], answers: list[Answer[EstopReply]]) -> None:
    """Raises NotReleasedError when any of the `wanted` services did not release its latch."""
    by_service = {answer.service: answer for answer in answers}
    reasons = []
    for service in sorted(wanted):
        answer = by_service.get(service, Answer(service, None, "no answer"))
        if answer.reply is None or answer.reply.latch != "released":
            why = answer.error or (answer.reply.text if answer.reply else "") or "it is still latched"
            reasons.append(f"{service} does not release the emergency stop: {why}")
    if reasons:
        raise NotReleasedError(tuple(reasons))
