"""A site's plan: one file, `site.toml`, that names hosts, robots, persons and their roles, and connects the hosts.

name = "lab"

[robot.calliope]
profile = "sim"                        # a profile's name, or a path relative to this file

[host.body]                            # a computer
role = "robot"                         # it drives hardware (or simulates it)
processes = ["capture", "sim"]         # those of the profile that run there
listen = ["tls/10.77.0.1:7447"]        # where its gateway accepts the others

[host.brain]
role = "brain"                         # it sees, plans and runs tasks
processes = ["perception", "planning", "executive"]

[person.ada]
role = "operator"                      # or "viewer", or "author"

A host connects to all hosts that listen, or to those that its `connect` names. Where a site has several robots, each
host names its own (`robot = "calliope"`), and a person may be limited to some (`robots = ["calliope"]`).
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta

from cocoro.component import Component
from cocoro.errors import ConfigError, choice_of, field_text
from cocoro.topics import FRAME
from deploy import profiles
from deploy.processes import COMPONENTS, components, hardware, named
from deploy.profiles import Name, Profile
from deploy.site.component import GATEWAY, gateway_of
from deploy.site.place import CREDENTIALS, PLAN
from deploy.site.roles import HostRole, PersonRole, Role
from services.cockpit.component import COCKPIT
from services.frames.component import PACKER, unpacker_of

T = TypeVar("T", bound=msgspec.Struct)
Endpoint = Annotated[str, Meta(pattern=r"\Atls/(\[[0-9a-fA-F:]+\]|[A-Za-z0-9.-]+):[0-9]{1,5}\Z")]
AN_ENDPOINT = "an endpoint is written as tls/ADDRESS:PORT"


LONGEST_HOST = 24
LOOPBACK = ("127.0.0.1", "localhost", "::1")


class RobotRow(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot of the site."""

    profile: str


class HostRow(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A computer of the site: a share of one robot's processes, and its gateway. A hub has its gateway alone, to which
    the hosts of all robots and the persons connect."""

    role: HostRole
    robot: Name = ""
    """The robot whose processes it runs; the site's only one where it is left out. A hub has none."""
    processes: tuple[Name, ...] = ()
    listen: tuple[Endpoint, ...] = ()
    connect: tuple[Name, ...] | None = None
    """The hosts that its gateway connects to; None stands for all others that listen."""


class PersonRow(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A person, or a program that acts for one."""

    role: PersonRole
    robots: tuple[Name, ...] | None = None
    """None stands for all."""


class _File(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    name: Name
    robot: Annotated[dict[Name, Any], Meta(min_length=1)]
    host: Annotated[dict[Name, Any], Meta(min_length=1)]
    person: dict[Name, Any] = {}


@dataclass(frozen=True)
class Site:
    """A site's plan, checked. Make it with `read`. It may have thousands of robots: who connects to whom is worked out
    once."""

    name: str
    path: Path
    sources: dict[str, str]
    """The name or path of each robot's profile."""
    profiles: dict[str, Profile]
    hosts: dict[str, HostRow]
    persons: dict[str, PersonRow]

    @property
    def folder(self) -> Path:
        return self.path.parent

    def role(self, name: str) -> Role:
        """The role of a principal. Raises ConfigError for a name that the site does not have."""
        row = self.hosts.get(name) or self.persons.get(name)
        if row is None:
            raise ConfigError(
                f"site {self.name} has no host and no person {name!r}; {choice_of(name, self.principals)}"
            )
        return row.role

    @property
    def principals(self) -> tuple[str, ...]:
        return (*self.hosts, *self.persons)

    def addresses(self, name: str) -> tuple[str, ...]:
        """The addresses at which a principal listens, which its certificate must name."""
        ends = self.hosts[name].listen if name in self.hosts else ()
        return tuple(dict.fromkeys(end.removeprefix("tls/").rpartition(":")[0].strip("[]") for end in ends))

    def host(self, name: str) -> HostRow:
        """Raises ConfigError for a host that the site does not have."""
        if name not in self.hosts:
            raise ConfigError(f"site {self.name} has no host {name!r}; {choice_of(name, self.hosts)}")
        return self.hosts[name]

    def robots_of(self, name: str) -> tuple[str, ...]:
        """The robots that a principal deals with."""
        if name in self.hosts:
            return tuple(self.profiles) if self.is_hub(name) else (self.hosts[name].robot,)
        robots = self.persons[name].robots
        return tuple(self.profiles) if robots is None else robots

    def deals_with_all(self, name: str) -> bool:
        """Whether a principal deals with every robot, whichever they are."""
        return self.is_hub(name) if name in self.hosts else self.persons[name].robots is None

    def deals_with(self, name: str, robot: str) -> bool:
        """Whether a principal deals with one robot; with `*`, whether with all, whichever they are."""
        if self.deals_with_all(name):
            return robot == "*" or robot in self.profiles
        return robot in (self.persons[name].robots or () if name in self.persons else (self.hosts[name].robot,))

    def robots_shared(self, name: str, other: str) -> tuple[str, ...]:
        """The robots that both principals deal with."""
        if self.deals_with_all(name):
            return self.robots_of(other)
        return tuple(robot for robot in self.robots_of(name) if self.deals_with(other, robot))

    def is_hub(self, name: str) -> bool:
        return name in self.hosts and self.hosts[name].role == "hub"

    @cached_property
    def _listening(self) -> Mapping[str, tuple[str, ...]]:
        """The hosts that listen, by robot; under `""` the hubs."""
        order = {name: number for number, name in enumerate(self.hosts)}
        hubs = [name for name, row in self.hosts.items() if row.listen and self.is_hub(name)]
        found: dict[str, list[str]] = {"": [], **{robot: [] for robot in self.profiles}}
        for name, row in self.hosts.items():
            if row.listen and row.robot in self.profiles:
                found[row.robot].append(name)
        return {robot: tuple(sorted((*names, *hubs), key=order.__getitem__)) for robot, names in found.items()}

    def listening(self, robot: str) -> tuple[str, ...]:
        """The hosts that accept others who deal with a robot: its own, and hubs."""
        return self._listening[robot]

    def entrances(self, robot: str) -> tuple[str, ...]:
        """The hosts by which a person reaches a robot: the hubs where there are any, else the robot's that listen."""
        hosts = self.listening(robot)
        return tuple(name for name in hosts if self.is_hub(name)) or hosts

    def keeper(self, host: str) -> str:
        """The host whose clock is the time of a host's robot: the first that drives its hardware, or its first one. A
        hub keeps its own."""
        return host if self.is_hub(host) else self.keeper_of(self.hosts[host].robot)

    def keeper_of(self, robot: str) -> str:
        """The host whose clock is a robot's time."""
        of_robot = [name for name, row in self.hosts.items() if row.robot == robot]
        return next((name for name in of_robot if self.hosts[name].role == "robot"), of_robot[0])

    def connects(self, name: str) -> tuple[str, ...]:
        """The hosts that a principal connects to."""
        return self._connects[name]

    def connected(self, name: str) -> tuple[str, ...]:
        """The principals that connect to a host."""
        return self._connected.get(name, ())

    @cached_property
    def _connects(self) -> Mapping[str, tuple[str, ...]]:
        order = {name: number for number, name in enumerate(self.hosts)}
        return {name: self._goes_to(name, order) for name in self.principals}

    @cached_property
    def _connected(self) -> Mapping[str, tuple[str, ...]]:
        found: dict[str, list[str]] = {}
        for name, hosts in self._connects.items():
            for host in hosts:
                found.setdefault(host, []).append(name)
        return {host: tuple(names) for host, names in found.items()}

    def _goes_to(self, name: str, order: Mapping[str, int]) -> tuple[str, ...]:
        if name in self.persons:
            found = (host for robot in self.robots_of(name) for host in self.entrances(robot))
            return tuple(dict.fromkeys(found))
        row = self.hosts[name]
        if row.connect is not None:
            return row.connect
        # Of two that listen the later one connects, so that each pair has one link; and no hub connects to a robot.
        hub = self.is_hub(name)
        there = self.listening("" if hub else row.robot)
        return tuple(
            host
            for host in there
            if host != name and not (row.listen and self.is_hub(host) == hub and order[host] > order[name])
        )

    def endpoints(self, name: str) -> tuple[str, ...]:
        """Where a principal connects to."""
        return tuple(endpoint for host in self.connects(name) for endpoint in self.hosts[host].listen)

    def share_profile(self, name: str, overrides: Iterable[str] = ()) -> Profile:
        """The profile of a host's share: its robot's profile with this host's processes, and those that join it with
        the others. Raises ConfigError for a host that the site does not have, and as `profiles.read` does."""
        row = self.host(name)
        settings = {"site": str(self.folder), "host": name}
        if self.is_hub(name):
            gateway = gateway_of(name).name
            return Profile(name=f"hub of {self.name}", robot=name, processes=(gateway,), service={"gateway": settings})
        whole = profiles.read(self.sources[row.robot], overrides)
        settings = {**whole.service.get(GATEWAY.name, {}), **settings}
        return msgspec.structs.replace(
            whole,
            robot=row.robot,
            processes=tuple(component.name for component in self.share(name)),
            service={**whole.service, GATEWAY.name: settings, **self._cockpit(whole, name)},
        )

    def _cockpit(self, whole: Profile, name: str) -> dict[str, dict[str, Any]]:
        """The table of a host's cockpit that is open to other machines: it shows the host's certificate and knows the
        site's persons, where it says nothing else."""
        given = whole.service.get(COCKPIT.name, {})
        if given.get("host", LOOPBACK[0]) in LOOPBACK:
            return {}
        ours = {"site": str(self.folder), "credentials": str(self.folder / CREDENTIALS / name)}
        return {COCKPIT.name: {**ours, **given}}

    def share(self, name: str) -> tuple[Component, ...]:
        """The components that run on a host: those of the plan, its gateway, and what carries frames between hosts,
        which themselves stay on theirs."""
        row = self.host(name)
        mine = tuple(named(process) for process in row.processes)
        makes = any(FRAME in component.publishes for component in mine)
        readers = [host for host, other in self.hosts.items() if other.robot == row.robot and self._takes_frames(host)]
        persons = [person for person in self.persons if row.robot in self.robots_of(person)]
        carriers = (PACKER,) if makes and (persons or set(readers) - {name}) else ()
        if not makes and name in readers:
            carriers = (unpacker_of(name),)
        return (*mine, gateway_of(name), *carriers)

    def _takes_frames(self, name: str) -> bool:
        """Whether a process of a host reads or records frames."""
        components = [named(process) for process in self.hosts[name].processes]
        return any(FRAME in component.reads or component.records for component in components)


def read(where: Path) -> Site:
    """Read a site's plan, from its file or the folder that holds it, and check it.

    Raises ConfigError that names file, table and field, and what to do.
    """
    path = (where / PLAN if where.is_dir() else where).resolve()
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"there is no site {path}: write one; `cocoro site --help` says more") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"site {path} cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"site {path}: {error}") from error
    try:
        site = _resolved(_converted(data, _File, ""), path)
        _check(site)
    except ConfigError as error:
        raise ConfigError(f"site {path}: {error}") from error
    return site


def _converted(data: Any, kind: type[T], table: str) -> T:
    """A table of the file as its type. Raises ConfigError that names table and field."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        text = field_text(error, kind)
        text = text.replace(f"Expected `str` matching regex {_pattern(Endpoint)!r}", AN_ENDPOINT)
        text = text.replace(f"Expected `str` matching regex {_pattern(Name)!r}", profiles.A_NAME)
        raise ConfigError(f"[{table}] {text}" if table else text) from error


def _rows(tables: dict[str, Any], kind: type[T], table: str) -> dict[str, T]:
    return {name: _converted(row, kind, f"{table}.{name}") for name, row in tables.items()}


def _pattern(kind: Any) -> str:
    return str(next(meta.pattern for meta in kind.__metadata__ if meta.pattern))


def _resolved(file: _File, path: Path) -> Site:
    """The site with each robot's profile, and each host's robot filled in."""
    sources, found = {}, {}
    for robot, row in _rows(file.robot, RobotRow, "robot").items():
        which = row.profile
        if which.endswith(".toml") and not Path(which).is_absolute():
            which = str(path.parent / which)
        sources[robot] = which
        try:
            found[robot] = msgspec.structs.replace(profiles.read(which), robot=robot)
        except ConfigError as error:
            raise ConfigError(f"[robot.{robot}] {error}") from error
    only = next(iter(found)) if len(found) == 1 else ""
    hosts = {
        name: row if row.robot or row.role == "hub" else msgspec.structs.replace(row, robot=only)
        for name, row in _rows(file.host, HostRow, "host").items()
    }
    return Site(file.name, path, sources, found, hosts, _rows(file.person, PersonRow, "person"))


def _check(site: Site) -> None:
    """Raises ConfigError for a plan that contradicts itself."""
    if both := sorted({*site.hosts} & {*site.persons}):
        raise ConfigError(f"{both[0]} is a host and a person: give one of them another name")
    for name, person in site.persons.items():
        for robot in person.robots or ():
            if robot not in site.profiles:
                raise ConfigError(f"[person.{name}] robots: no robot {robot!r}; {choice_of(robot, site.profiles)}")
        if any(name in one.services for one in components()):
            raise ConfigError(f"[person.{name}]: a service has this name; an author's keys lie under his own name")
    for name, host in site.hosts.items():
        _check_host(site, name, host)
    hosts: dict[str, dict[str, HostRow]] = {robot: {} for robot in site.profiles}
    for name, host in site.hosts.items():
        if host.robot:
            hosts[host.robot][name] = host
    for robot, profile in site.profiles.items():
        _check_shares(site, robot, profile, hosts[robot])


def _check_host(site: Site, name: str, host: HostRow) -> None:
    where = f"[host.{name}]"
    if len(name) > LONGEST_HOST:
        raise ConfigError(f"{where}: a host's name has at most {LONGEST_HOST} characters, since its gateway's has 32")
    if host.role == "hub":
        if host.robot or host.processes:
            raise ConfigError(f"{where}: a hub has its gateway alone: leave robot and processes out")
        if not host.listen:
            raise ConfigError(f"{where}: a hub listens: give it listen = ['tls/ADDRESS:PORT']")
        if name in site.profiles:
            raise ConfigError(f"{where}: a robot has this name; give the hub another")
    elif not host.processes:
        raise ConfigError(f"{where}: name its processes, those of the profile that run there: processes = [...]")
    elif not host.robot:
        raise ConfigError(f"{where}: the site has several robots, so each host names its own: robot = ...")
    elif host.robot not in site.profiles:
        raise ConfigError(f"{where} robot: no robot {host.robot!r}; {choice_of(host.robot, site.profiles)}")
    for process in host.processes:
        component = named(process)
        if process not in site.profiles[host.robot].processes:
            of = site.profiles[host.robot]
            raise ConfigError(f"{where} processes: {process} is none of profile {of.name}'s: {', '.join(of.processes)}")
        drives = {*component.services} & {*hardware()}
        if drives and host.role != "robot":
            raise ConfigError(f"{where} processes: {process} drives {sorted(drives)[0]}, so its host has role 'robot'")
        if foreign := _foreign_key(component):
            raise ConfigError(
                f"{where} processes: {process} of a third party publishes {foreign}; on a site it may publish and serve"
                f" only under its own services: {', '.join(component.services)}"
            )
    for other in host.connect or ():
        if other == name or other not in site.hosts:
            raise ConfigError(f"{where} connect: no other host {other!r}; {choice_of(other, site.hosts)}")
        if not site.hosts[other].listen:
            raise ConfigError(f"{where} connect: {other} does not listen; give it listen = ['tls/ADDRESS:PORT']")
    for endpoint in host.listen:
        if not 0 < int(endpoint.rpartition(":")[2]) < 65536:
            raise ConfigError(f"{where} listen: {endpoint} has no port between 1 and 65535")


def _foreign_key(component: Component) -> str:
    """A key that a third party's component would publish or serve beyond its own services; '' when there is none."""
    if component in COMPONENTS:
        return ""
    keys = [row.name for row in component.all_publishes()] + [row.name for row in component.all_serves()]
    return next((key for key in keys if key.partition("/")[0] not in component.services), "")


def _check_shares(site: Site, robot: str, profile: Profile, hosts: Mapping[str, HostRow]) -> None:
    for process in profile.processes:
        on = [name for name, host in hosts.items() if process in host.processes]
        if len(on) != 1 and not (named(process).optional and not on):
            there = f"on {' and on '.join(on)}" if on else "on no host"
            raise ConfigError(f"[robot.{robot}]: process {process} runs {there}; give it to one host's processes")
    if len(hosts) > 1:
        joined = (*hosts, *(name for name in site.listening("")))
        reached = {next(iter(hosts))}
        links = [{name, other} for name in joined for other in site.connects(name)]
        for _ in joined:
            for link in links:
                if reached & link:
                    reached |= link
        if missing := [name for name in hosts if name not in reached]:
            raise ConfigError(
                f"[robot.{robot}]: {missing[0]} and {min(reached)} are not connected: let one of them listen"
            )
