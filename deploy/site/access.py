"""The way of a person to a robot of a site: as a client of the hosts that listen, by his certificate."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from cocoro.bus.endpoints import ZenohConfig
from cocoro.errors import ConfigError, choice_of
from deploy.rundir import RunDir
from deploy.site import admitted, credentials, place, plan
from deploy.site.plan import Site
from deploy.site.rights import Rights, rights

PATIENCE_S = 3.0
"""Longest wait for the mesh over a network."""


class Way(NamedTuple):
    """How a person reaches a robot."""

    run_dir: RunDir
    """The robot's folder on this machine."""
    config: ZenohConfig
    who: str
    """The person, with role and site, for error messages."""
    rights: Rights
    keeper: str
    """The host that keeps the robot's time; '' where that is the simulator's."""

    def refusal(self, key: str) -> str:
        """Why the person may not send a request on this key (wildcards allowed); '' when he may."""
        return "" if key in self.rights.asks or self.rights.may_ask(key) else f"{self.who} may not ask {key}"


def way(given: str, robot: str | None, command: str) -> Way:
    """The way to one robot. `given` is `NAME@DIR` or `DIR`, `command` the name in logs. Raises ConfigError for a site,
    a name or credentials that cannot be used, and where the robot must be chosen."""
    found = ways(given, robot, command)
    if len(found) > 1:
        names = " or ".join(f"--robot {one.run_dir.robot}" for one in found)
        raise ConfigError(f"the site has several robots; choose one: {names}")
    return found[0]


def ways(given: str, robot: str | None, command: str) -> list[Way]:
    """As `way`, to one robot or, without a name, to each that the person deals with."""
    who, at, folder = given.rpartition("@")
    site = plan.read(Path(folder))
    name = who if at else _only(site)
    role = site.role(name)
    theirs = site.robots_of(name)
    if robot is not None and robot not in theirs:
        raise ConfigError(f"{name} has nothing to do with {robot}; {choice_of(robot, theirs)}")
    known = admitted.read(site.folder)
    mine = credentials.read(
        site.folder / place.CREDENTIALS / name, datetime.now(UTC), name=name, role=role, authority=known.authority
    )
    found = []
    for one in theirs if robot is None else (robot,):
        endpoints = tuple(end for host in site.entrances(one) for end in site.hosts[host].listen)
        if not endpoints:
            raise ConfigError(f"site {site.name}: no host of {one} listens: give one listen = ['tls/ADDRESS:PORT']")
        config = ZenohConfig(command, mode="client", connect=endpoints, patience_s=PATIENCE_S, options=mine.options)
        who = f"{name}, {role} of site {site.name},"
        keeper = "" if site.profiles[one].clock == "sim" else site.keeper_of(one)
        found.append(Way(RunDir(one), config, who, rights(site, name, one), keeper))
    return found


def _only(site: Site) -> str:
    """The one whose credentials are here. Raises ConfigError when there are none or several."""
    folder = site.folder / place.CREDENTIALS
    here = [name for name in site.principals if (folder / name).is_dir()]
    persons = [name for name in here if name in site.persons] or here
    if len(persons) == 1:
        return persons[0]
    if not persons:
        raise ConfigError(f"{folder}: no credentials are here; copy yours from the machine that issues (`cocoro pki`)")
    raise ConfigError(f"{folder} has several credentials; say whose: --site {persons[0]}@{site.folder}")
