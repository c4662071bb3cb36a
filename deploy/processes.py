"""What runs: one table. Profiles name its rows, the supervisor, `top`, the unit files and the budget test read it.

Third parties add rows of their own by the entry point group `cocoro.processes`; the entry point is named as its process
and points to a `Process` (see `cocoro.component`).
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

from cocoro.bus.shared import need_bytes
from cocoro.component import Process
from cocoro.errors import ConfigError

GROUP = "cocoro.processes"
"""The entry point group of third parties' rows."""
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
