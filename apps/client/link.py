"""The access of commands and programs to a robot's mesh: a participant that is no service."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apps.client.choice import RobotChoice
from cocoro.bus.base import Bus
from cocoro.bus.zenoh import ZenohBus
from cocoro.errors import MeshError, RefusedError, choice_of
from cocoro.participant import Answer, Q, R
from cocoro.topics import Request
from deploy.rundir import START, RunDir, robots
from deploy.site.place import SITE
from deploy.survey import REPLAY, Onlooker
from deploy.which_robot import only, started_with, up_here

if TYPE_CHECKING:
    from cocoro.objects import Catalogue
    from cocoro.robot import Robot

__all__ = ["Answer", "MeshLink", "find", "joined"]

PERCEPTION = "perception"
"""The component that detects the known objects."""


class MeshLink(Onlooker):
    """An operator's participant of the mesh. Make it with `joined`."""

    def __init__(
        self, run_dir: RunDir, bus: Bus, private: bool = True, refusal: Callable[[str], str] | None = None
    ) -> None:
        """`private`: only processes of this machine can be in this mesh. `refusal` says why a request on a key may not
        be sent, as the site's rules have it."""
        super().__init__(run_dir, bus, private)
        self._refusal = refusal
        self.here = refusal is None
        """Whether the robot is on this machine, not beyond a site's gateway."""

    async def _ask(self, request: Request[Q, R], question: Q, timeout_s: float | None) -> list[Answer[R]]:
        if self._refusal is not None and (why := self._refusal(request.key(self.robot_name))):
            raise RefusedError(why)  # the gateway would drop it, and nobody would answer
        return await super()._ask(request, question, timeout_s)

    async def described(self) -> Robot:
        """The robot by the files that it was started with, if it is on this machine; else as its services state it.
        Raises ConfigError; MeshError where no service of another machine's robot states it."""
        if self.here:
            return await asyncio.to_thread(started_with(self.run_dir).load)
        from apps.client.stated import stated_robot  # slow to import; few commands need it

        return await stated_robot(self)

    def catalogue(self) -> Catalogue:
        """The objects that the running robot knows, if their file is on this machine; else the project's own. Raises
        ConfigError."""
        from cocoro.objects import Catalogue

        file = self.catalogue_file()
        return Catalogue.load(file if file is not None and file.exists() else None)

    def catalogue_file(self) -> Path | None:
        """The file of known objects that the running robot was started with, if any."""
        resolved = self.run_dir.resolved()
        named = resolved.get("objects") or resolved.get("service", {}).get(PERCEPTION, {}).get("objects")
        return Path(named) if named else None

    def unserved(self, request: Request[Any, Any]) -> str:
        return self.missing(request.server, START)

    def missing(self, service: str, advice: str = "") -> str:
        """The error's text for a service that this command did not find: whether its process lives, by its claim."""
        by = self.run_dir.claimant(service)
        if by is not None and by.name != REPLAY:
            return (
                f"no contact with {service} though its process {by.pid} lives: this machine may be too busy, or it"
                " hangs; try again, and see `cocoro top`"
            )
        return f"{self.robot} has no {service} running: {f'{advice}, or ' if advice else ''}see `cocoro status`"

    def refused(self, answer: Answer[Any]) -> str:
        return f"{answer.service}: {answer.error}"


def through_site(choice: RobotChoice) -> str | None:
    """The site to go through: the chosen one, or that of $COCORO_SITE where no robot is up on this machine."""
    if choice.site is not None:
        return choice.site
    given = os.environ.get(SITE)
    return given if given and not robots() else None


def find(choice: RobotChoice) -> RunDir:
    """The robot that a command is for. Raises MeshError when none is up, ConfigError when several are."""
    if choice.robot is not None:
        return up_here(choice.robot)
    up = robots()
    if not up:
        raise MeshError(f"no robot is up on this machine: {START}")
    return only(up)


@asynccontextmanager
async def joined(
    choice: RobotChoice, patience_s: float | None = None, *, frames: bool = False, best: bool = False
) -> AsyncIterator[MeshLink]:
    """Joins the mesh of a robot. Raises MeshError when there is none. `frames`: the command reads frames, or all
    keys. `best`: over a site, it wants few pictures as good as they can be, rather than many in time."""
    if (through := through_site(choice)) is not None:
        from deploy.site import access  # slow to import; only a site needs it

        way = access.way(through, choice.robot, "operator")
        run_dir, config, refusal, keeper = way.run_dir, way.config, way.refusal, way.keeper
    else:
        refusal, keeper = None, ""
        run_dir = find(choice)
        config = run_dir.join_as("operator")
        if config.directory is not None and not run_dir.populated:
            up = [other.robot for other in robots()]
            advice = choice_of(run_dir.robot, up) if up else START
            raise MeshError(f"{run_dir.robot} is not up on this machine: {advice}")
    config = replace(config, shared_memory=frames)
    if patience_s is not None:
        config = replace(config, patience_s=patience_s)
    async with await ZenohBus.open(config, expect_mesh=True) as bus:
        link = MeshLink(run_dir, bus, private=config.directory is not None, refusal=refusal)
        link.paced = refusal is not None
        if refusal is not None and not await link.alive():
            why = "is it up there, or has your certificate been revoked?"
            raise MeshError(f"nothing of {link.robot} is heard at {config.where}: {why}")
        if keeper:
            from deploy.site import asking

            link.clock = await asking.time_of(link, keeper) or link.clock
        if frames and refusal is not None:
            from apps.client.packed_frames import unpacking  # slow to import; only a site needs it

            link.bus = unpacking(bus, run_dir.robot, link, best=best)
        yield link
