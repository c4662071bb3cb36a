"""Components: values that declare what a process reads, publishes and needs, and how it is run.

A declaration is light: it names the module of the implementation, and only the process that runs the component imports
that module. The declarations of this project are united in `deploy.processes`; third parties add theirs by entry point
(`cocoro.installed`).
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Awaitable, Callable, Iterable, Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

import msgspec

from cocoro.checks import Check
from cocoro.errors import ConfigError
from cocoro.topics import STOPS, Request, Topic

if TYPE_CHECKING:
    from cocoro.core import Core
    from cocoro.node import Node
    from cocoro.robot import Robot

C = TypeVar("C", bound=msgspec.Struct)

Restart = Literal["never", "on-failure", "always"]


@dataclass(frozen=True)
class Implementation(Generic[C]):
    """The value `implementation` of a component's module: its settings, its main coroutine, its core."""

    config: type[C]
    """A frozen msgspec struct; all fields have defaults, unknown fields are forbidden."""
    run: Callable[[Node, C], Awaitable[None]]
    """An `async def` that never returns."""
    core: Callable[[Robot, C], Core] | None = None
    """Makes the pure core that `run` drives; with it a capture of the component can be re-executed."""


@dataclass(frozen=True, kw_only=True)
class Component:
    """One process: its topics and requests, its dependencies, how it is run, its budget.

    A topic or request with `{service}` in its name stands for each of this component's services where the component
    publishes or serves it, and for any service where the component reads or calls it. What every node publishes, serves
    and reads (health, records of steps and requests, `about`, the clock) is not declared.
    """

    name: str
    """The process's name, and by default that of its service."""
    module: str
    """The module with `implementation = Implementation(...)`; only `load` imports it."""
    doc: str
    services: tuple[str, ...] = ()
    """The services that it provides; it is ready when all of them have declared their liveliness."""

    reads: tuple[Topic[Any], ...] = ()
    publishes: tuple[Topic[Any], ...] = ()
    serves: tuple[Request[Any, Any], ...] = ()
    calls: tuple[Request[Any, Any], ...] = ()
    records: bool = False
    """It receives every key of the robot, besides those of `reads`."""
    needs: tuple[str, ...] = ()
    """Services that it cannot work without. Those that these need in turn are not listed."""
    moves: tuple[str, ...] = ()
    """Those of its services that move something. Each must serve the emergency stop."""
    hardware: bool = False
    """It drives a device that the simulator impersonates."""

    optional: bool = False
    """The robot works without it, so the hosts of a site may all leave it out."""
    settings: str = ""
    """The name of the `[service.NAME]` table that it is configured by, if that is not its own."""
    restart: Restart = "on-failure"
    backoff_s: float = 0.5
    """Delay before the first restart; doubled for each further one, up to `deploy.processes.BACKOFF_LIMIT_S`."""
    first: bool = False
    """Where the robot's time is real, the other processes are started when it is ready."""
    start_s: float = 30.0
    """Time until it must be ready."""
    stop_s: float = 5.0
    """Time from SIGTERM to SIGKILL."""
    frames: Literal["", "reads", "publishes"] = ""
    """Whether it publishes or reads frames, which then travel in shared memory; otherwise they are copied."""
    nice: int = 0
    """Scheduling priority relative to the others: above 0 it yields to them, below 0 they yield to it, where that is
    allowed (LimitNICE in the unit file)."""
    cpu_share: float = 0.25
    """Budget, as a share of one core of the machine that the project is measured on."""
    rss_mb: float = 150.0
    """Budget of resident memory."""

    imports_later: tuple[str, ...] = ()
    """Modules that its process imports soon after its start. Without, the first that needs one would import it in the
    middle of its work, and the process would stand still meanwhile."""
    libraries: tuple[str, ...] = ()
    """Distributions that it needs beside those of the mesh; `cocoro doctor` looks for them."""
    checks: str = ""
    """A module with `check(config, robot, robot_name) -> list[Check]`, for `cocoro doctor`."""

    def __post_init__(self) -> None:
        """Raises ConfigError for a declaration that contradicts itself."""
        if not self.services:
            object.__setattr__(self, "services", (self.name,))
        if unknown := sorted(set(self.moves) - set(self.services)):
            raise ConfigError(f"component {self.name}: it moves {unknown[0]}, which is none of its services")
        served = {request.name for request in self.all_serves()}
        for service in self.moves:
            if any(request.of(service).name not in served for request in STOPS):
                raise ConfigError(f"component {self.name}: {service} moves something, so it must serve STOPS")

    def all_publishes(self) -> Iterator[Topic[Any]]:
        """The published topics, those with `{service}` resolved for each service."""
        for topic in self.publishes:
            yield from (topic.of(service) for service in self.services) if topic.per_service else (topic,)

    def all_serves(self) -> Iterator[Request[Any, Any]]:
        """The served requests, those with `{service}` resolved for each service."""
        for request in self.serves:
            yield from (request.of(service) for service in self.services) if request.per_service else (request,)

    def speaker(self, topic: Topic[Any]) -> str:
        """The service of this component that publishes a topic: the one that the topic lies under, else the process."""
        return topic.service if topic.service in self.services else self.name


def load(component: Component) -> Implementation[Any]:
    """Import a component's implementation. Raises ConfigError when its module is missing or has none."""
    where = f"component {component.name}: {component.module}"
    found = getattr(_module(component.module, f"component {component.name}"), "implementation", None)
    if not isinstance(found, Implementation):
        raise ConfigError(f"{where} has no `implementation = Implementation(CONFIG, run)`, see cocoro.component")
    if not (isinstance(found.config, type) and issubclass(found.config, msgspec.Struct)):
        raise ConfigError(f"{where}: its implementation's config is no class of msgspec.Struct")
    if not inspect.iscoroutinefunction(found.run):
        raise ConfigError(f"{where}: its implementation's run is no `async def run(node, config)`")
    return found


def machine_checks(component: Component, config: Any, robot: Robot, robot_name: str) -> Iterable[Check]:
    """Run a component's own checks of the machine; none for a component without any. Raises ConfigError when its
    module of checks is missing."""
    if not component.checks:
        return ()
    found: Iterable[Check] = _module(component.checks, f"component {component.name}").check(config, robot, robot_name)
    return found


def _module(name: str, whose: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name and (name == error.name or name.startswith(f"{error.name}.")):
            raise ConfigError(f"{whose}: there is no module {name}") from error
        raise
