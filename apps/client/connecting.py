"""`cocoro.connect`: joins a robot's mesh, on this machine or through a site."""

from __future__ import annotations

import os
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial

from apps.client.choice import RobotChoice
from apps.client.link import joined
from apps.client.robot import RobotClient
from cocoro.bus.base import Bus
from cocoro.clock import Clock
from cocoro.errors import ConfigError
from cocoro.participant import Participant
from cocoro.stop.asking import Asking
from deploy.contact import ProcessContact, SleepDetector

STOP_S = 0.6
"""Longest wait for acknowledgements on the stop path."""


@asynccontextmanager
async def connect(
    robot: str | None = None, *, site: str | None = None, bus: Bus | None = None, clock: Clock | None = None
) -> AsyncIterator[RobotClient]:
    """Joins a robot's mesh: `async with cocoro.connect() as robot: await robot.fetch("red_can")`.

    `robot`: its name; not needed where one robot is up on this machine. `site`: reach it on other machines, through a
    site: `NAME@DIR` or `DIR`. `bus` and `clock`: a mesh that the caller has joined already, such as one in virtual
    time, where the robot's name must be given.

    Raises MeshError when no such robot is up, ConfigError when several are and none was named.
    """
    if bus is not None or clock is not None:
        if bus is None or clock is None or robot is None or site is not None:
            raise ConfigError("connect: give the robot's name, `bus` and `clock` together, without `site`")
        participant = _Onlooker(bus, clock, robot)
        try:
            async with RobotClient(participant) as client:
                yield client
        finally:
            participant.close()
        return
    async with joined(RobotChoice(robot, site), frames=True) as link:
        contact = ProcessContact(link.run_dir.claimant_pid, SleepDetector())
        path = partial(_by_path, link.robot) if link.here else None
        async with RobotClient(link, contact=contact, described=link.described, stop_path=path) as client:
            yield client


class _Onlooker(Participant):
    onlooker = True


def _by_path(robot: str) -> frozenset[str]:
    """Stops a robot of this machine by the stop path; returns the services of this user's that acknowledged. Raises
    OSError where the stop path cannot be used."""
    with Asking(robot) as asking:
        asking.go_on(time.monotonic() + STOP_S)
        points = asking.points.values()
        return frozenset(one.service for one in points if one.latched_ns is not None and one.uid == os.getuid())
