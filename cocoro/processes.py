"""What runs: one table. Profiles name its rows, the supervisor, `top`, the unit files and the budget test read it.

A component is a module with a `Config` (a frozen msgspec struct, all fields with defaults, unknown fields
forbidden) and `async def run(node, config)`, which never returns. One that drives a pure core also has
`def core(robot, config)` that makes it, so that its captures can be executed again. Third parties add rows of their
own by the entry point group `cocoro.processes`; the entry point is named as its process and points to a `Process`.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec

from cocoro.bus.shared import need_bytes
from cocoro.errors import ConfigError

if TYPE_CHECKING:
    from cocoro.core import Core
    from cocoro.node import Node
    from cocoro.robot import Robot

Restart = Literal["never", "on-failure", "always"]
Run = Callable[["Node", Any], Awaitable[None]]
MakeCore = Callable[["Robot", Any], "Core"]

GROUP = "cocoro.processes"
"""The entry point group of third parties' rows."""


@dataclass(frozen=True, kw_only=True)
class Process:
    """One row: what is started, when it counts as ready, what becomes of it when it ends, what it may cost."""

    name: str
    module: str
    """Imported by name, so that this package needs none of them."""
    services: tuple[str, ...]
    """It is ready when all of these have declared their liveliness."""
    doc: str
    settings: str = ""
    """Whose `[service.NAME]` table it reads; its own where nothing is said."""
    restart: Restart = "on-failure"
    backoff_s: float = 0.5
    """Before the first restart; doubled for each further one, up to `BACKOFF_LIMIT_S`."""
    start_s: float = 30.0
    """It must be ready by then."""
    stop_s: float = 5.0
    """From SIGTERM to SIGKILL."""
    frames: Literal["", "reads", "publishes"] = ""
    """Whether it publishes frames or reads them: these travel in shared memory then. For who does not say so, they are
    copied, which costs more."""
    nice: int = 0
    """Steps by which it yields the processor to others: what may be late must not make commands late. Below 0 the
    others yield to it, where that is allowed (LimitNICE in the unit file)."""
    cpu_share: float = 0.25
    """Budget, of one core, on the machine that the project is measured on."""
    rss_mb: float = 150.0
    """Budget of resident memory."""


BACKOFF_LIMIT_S = 10.0
SETTLED_S = 30.0
"""A process that has been ready for so long is forgiven its restarts."""

PROCESSES: tuple[Process, ...] = (
    Process(
        name="sim", module="sim.service", services=("kinect", "base", "arm", "hand"),
        doc="The simulated robot: stands in for all hardware services, key for key.",
        frames="publishes", start_s=60.0, cpu_share=1.0, rss_mb=600.0,
    ),
    Process(
        name="kinect", module="services.kinect.service", services=("kinect",),
        doc="The Kinect: colour and raw depth.",
        frames="publishes", restart="always", cpu_share=0.3, rss_mb=200.0,
    ),
    Process(
        name="base", module="services.base.service", services=("base",),
        doc="The Create: wheels, bumpers, cliffs, battery. Small, because a Create keeps driving when its driver dies.",
        restart="always", backoff_s=0.1, nice=-10, cpu_share=0.15,
    ),
    Process(
        name="servos", module="services.servos.service", services=("arm", "hand"),
        doc="Both Dynamixel networks: neck and arm, hand.",
        restart="always", backoff_s=0.1, nice=-10, cpu_share=0.25,
    ),
    Process(
        name="perception", module="services.perception.service", services=("perception",),
        doc="Finds the known objects in each frame.",
        frames="reads", nice=5, cpu_share=0.5, rss_mb=250.0,
    ),
    Process(
        name="planning", module="services.planning.service", services=("planning",),
        doc="Turns intent and the latest state into head, wheel, arm and hand commands, 50 times a second.",
        cpu_share=0.4, rss_mb=200.0,
    ),
    Process(
        name="executive", module="services.executive.service", services=("executive",),
        doc="Runs the tasks: fetch, park, put-down; keeps the emergency stop's latch.",
        cpu_share=0.2,
    ),
    Process(
        name="capture", module="services.capture.service", services=("capture",),
        doc="Records the mesh into MCAP files.",
        frames="reads", nice=10, cpu_share=0.3, rss_mb=300.0,
    ),
    Process(
        name="wire", module="sim.wire.service", services=("kinect",), settings="sim",
        doc="The simulated robot behind wires: the camera, and ports with base and servos at their other ends.",
        frames="publishes", start_s=60.0, cpu_share=1.0, rss_mb=600.0,
    ),
)  # fmt: skip


class Component(NamedTuple):
    """A process's module, loaded."""

    config: type[Any]
    run: Run
    core: MakeCore | None = None


@cache
def table() -> dict[str, Process]:
    """All rows by name, third parties' included. Raises ConfigError for a row that is no row or takes a taken name."""
    from importlib.metadata import entry_points  # takes a while to import, and not everyone needs it

    rows = {process.name: process for process in PROCESSES}
    for point in entry_points(group=GROUP):
        where = f"entry point {point.name!r} of {point.dist.name if point.dist else 'an unknown distribution'}"
        if point.name in rows:
            raise ConfigError(f"{where}: there is a process of that name already")
        try:
            row = point.load()
        except Exception as error:
            raise ConfigError(f"{where} cannot be loaded: {type(error).__name__}: {error}") from error
        if not isinstance(row, Process) or row.name != point.name:
            raise ConfigError(f"{where}: {point.value} is not a Process named {point.name!r}")
        rows[row.name] = row
    return rows


def shared_bytes(rows: Iterable[Process]) -> int:
    """The room in the machine's shared memory that these processes take for their frames."""
    kinds = [row.frames for row in rows]
    return need_bytes(publishers=kinds.count("publishes"), readers=kinds.count("reads"))


def named(name: str) -> Process:
    """A row. Raises ConfigError that lists the known ones."""
    for process in PROCESSES:  # spares the search for entry points
        if process.name == name:
            return process
    if name not in table():
        raise ConfigError(f"there is no process {name!r}; known are {', '.join(table())}")
    return table()[name]


def load(process: Process) -> Component:
    """Import a process's module. Raises ConfigError when it is missing or is not a component."""
    try:
        module = importlib.import_module(process.module)
    except ModuleNotFoundError as error:
        if error.name and (process.module == error.name or process.module.startswith(f"{error.name}.")):
            raise ConfigError(f"process {process.name}: there is no module {process.module}") from error
        raise
    config, run = getattr(module, "Config", None), getattr(module, "run", None)
    if not (isinstance(config, type) and issubclass(config, msgspec.Struct)):
        raise ConfigError(f"process {process.name}: {process.module} has no Config (a msgspec.Struct)")
    if not inspect.iscoroutinefunction(run):
        raise ConfigError(f"process {process.name}: {process.module} has no `async def run(node, config)`")
    return Component(config, run, getattr(module, "core", None))
