"""The union of the project's own components and of those that third parties have installed.

Profiles name components, the supervisor starts each as a process, and everything else that depends on which components
there are is derived from their declarations here.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

from cocoro.bus.shared import need_bytes
from cocoro.component import Component
from cocoro.errors import ConfigError, choice_of
from cocoro.installed import third_parties
from cocoro.topics import ANY, Topic
from deploy.site.component import GATEWAY, PREFIX, gateway_of
from services.base.component import BASE
from services.capture.component import CAPTURE
from services.cockpit.component import COCKPIT
from services.executive.component import EXECUTIVE
from services.frames.component import PACKER, UNPACKER, UNPACKER_PREFIX, unpacker_of
from services.kinect.component import KINECT
from services.perception.component import PERCEPTION
from services.planning.component import PLANNING
from services.policy.component import POLICY
from services.servos.component import SERVOS, SERVOS_BASE
from sim.component import SIM
from sim.wire.component import WIRE

BACKOFF_LIMIT_S = 10.0
SETTLED_S = 30.0
"""A process that has been ready for this long starts again without the waits of its earlier restarts."""

COMPONENTS: tuple[Component, ...] = (
    SIM, KINECT, BASE, SERVOS, PERCEPTION, PLANNING, EXECUTIVE, CAPTURE, COCKPIT, WIRE, GATEWAY, PACKER, UNPACKER,
    POLICY, SERVOS_BASE,
)  # fmt: skip
"""The project's own."""


@cache
def table() -> dict[str, Component]:
    """All components by name. Raises ConfigError for a third party's that is faulty or takes a taken name."""
    third_parties().check()
    known = {component.name: component for component in COMPONENTS}
    for name, component in third_parties().components.items():
        if name in known:
            raise ConfigError(f"{component.module} of a third party: there is a component named {name!r} already")
        known[name] = component
    return known


def components() -> tuple[Component, ...]:
    """All components that can be used; unlike `table` this leaves out third parties' faulty ones."""
    own = {component.name for component in COMPONENTS}
    return COMPONENTS + tuple(one for one in third_parties().components.values() if one.name not in own)


def named(name: str) -> Component:
    """The component of that name. Raises ConfigError that lists the known ones."""
    for component in COMPONENTS:  # spares the search for entry points
        if component.name == name:
            return component
    if name.startswith(PREFIX):
        return gateway_of(name.removeprefix(PREFIX))
    if name.startswith(UNPACKER_PREFIX):
        return unpacker_of(name.removeprefix(UNPACKER_PREFIX))
    if name not in table():
        raise ConfigError(f"there is no process {name!r}; {choice_of(name, table())}")
    return table()[name]


def by_module(module: str) -> Component | None:
    """The component whose implementation a capture names; None when there is none here."""
    return next((component for component in components() if component.module == module), None)


# --- derived from the declarations ----------------------------------------------------------------


def hardware() -> tuple[str, ...]:
    """The services that drive devices, whose keys the simulator impersonates."""
    return _distinct(service for component in components() if component.hardware for service in component.services)


def stoppable() -> tuple[str, ...]:
    """The services that move something, and so answer the emergency stop."""
    return _distinct(service for component in components() for service in component.moves)


def publishers(topic: Topic[Any], among: Iterable[Component] | None = None) -> tuple[str, ...]:
    """The services that publish a topic, by all components or `among` some; `ANY` for a per-service row."""
    if topic.per_service:
        return (ANY,)
    found = ((one, declared) for one in among or components() for declared in one.all_publishes())
    return _distinct(one.speaker(topic) for one, declared in found if declared.name == topic.name)


def readers(topic: Topic[Any], among: Iterable[Component] | None = None) -> tuple[str, ...]:
    """The components that read a topic, by name; a recorder reads everything, and is not among them."""
    return _distinct(one.name for one in among or components() if topic.name in {read.name for read in one.reads})


def needs(name: str, started: Iterable[Component] = ()) -> tuple[str, ...]:
    """The services that a component cannot work without: those that it declares, and what these need in turn, each by
    the component that provides it among `started`, else by any."""
    providers = {service: one for one in (*reversed(components()), *started) for service in one.services}
    needed: set[str] = set()
    waiting = list(named(name).needs)
    while waiting:
        service = waiting.pop()
        if service not in needed:
            needed.add(service)
            waiting += providers[service].needs if service in providers else ()
    needed -= set(named(name).services)
    in_order = (*(service for one in components() for service in one.services), *sorted(needed))
    return tuple(service for service in _distinct(in_order) if service in needed)


def shared_bytes(started: Iterable[Component]) -> int:
    """The shared memory of the machine that these components take for their frames, bytes."""
    kinds = [component.frames for component in started]
    return need_bytes(publishers=kinds.count("publishes"), readers=kinds.count("reads"))


def _distinct(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))
