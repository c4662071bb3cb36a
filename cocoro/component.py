"""What a component is, and the process that runs it.

A component is a module with a `Config` (a frozen msgspec struct, all fields with defaults, unknown fields
forbidden) and `async def run(node, config)`, which never returns. One that drives a pure core also has
`def core(robot, config)` that makes it, so that its captures can be executed again.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec

from cocoro.errors import ConfigError

if TYPE_CHECKING:
    from cocoro.core import Core
    from cocoro.node import Node
    from cocoro.robot import Robot

Restart = Literal["never", "on-failure", "always"]
Run = Callable[["Node", Any], Awaitable[None]]
MakeCore = Callable[["Robot", Any], "Core"]


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


class Component(NamedTuple):
    """A process's module, loaded."""

    config: type[Any]
    run: Run
    core: MakeCore | None = None


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
