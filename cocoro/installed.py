"""Components of third parties, and all topics and requests: the project's own and those of third parties.

A distribution adds a component by an entry point of the group `cocoro.components`: named as the component, with its
`Component` as the value. A faulty entry point is an error where components are started (`ThirdParties.check`).
Everywhere else it is ignored, so that it cannot stop a recorder or disable an operator's command.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any, NamedTuple

from cocoro.component import Component
from cocoro.entry_points import added_to
from cocoro.errors import ConfigError
from cocoro.topics import REQUESTS, TOPICS, Request, Topic, find_topic

GROUP = "cocoro.components"


class ThirdParties(NamedTuple):
    components: dict[str, Component]
    """By name; without those that are faulty."""
    topics: tuple[Topic[Any], ...]
    """Topics that they publish or read, without the project's own."""
    requests: tuple[Request[Any, Any], ...]
    problems: tuple[str, ...]
    """One for each faulty entry point."""

    def check(self) -> None:
        """Raises ConfigError for the first faulty entry point."""
        if self.problems:
            raise ConfigError(self.problems[0])


@cache
def third_parties() -> ThirdParties:
    """All installed components of third parties; found once in a process."""
    components: dict[str, Component] = {}
    topics: dict[str, Topic[Any]] = {}
    requests: dict[str, Request[Any, Any]] = {}
    found = added_to(GROUP)
    problems = list(found.faults)
    for name, component, origin in found.added:
        try:
            if not isinstance(component, Component) or component.name != name:
                raise ConfigError(f"its value is not a Component named {name!r}")
            if name in components:
                raise ConfigError("there is a component of that name already")
            new_topics = _new((*component.publishes, *component.reads), TOPICS, topics)
            new_requests = _new((*component.serves, *component.calls), REQUESTS, requests)
        except ConfigError as error:
            problems.append(f"{origin}: {error}")
        else:
            components[name] = component
            topics |= new_topics
            requests |= new_requests
    return ThirdParties(components, tuple(topics.values()), tuple(requests.values()), tuple(problems))


def topic_named(name: str) -> Topic[Any] | None:
    """The topic of a name (its key without the robot), the project's own or a third party's; None when unknown."""
    return find_topic(name, TOPICS) or find_topic(name, third_parties().topics)


def all_topics() -> tuple[Topic[Any], ...]:
    """The project's own topics, then those of third parties."""
    return TOPICS + third_parties().topics


def unrecorded() -> tuple[str, ...]:
    """The names of the topics that recorders leave out."""
    return tuple(topic.name for topic in all_topics() if not topic.recorded)


def all_requests() -> tuple[Request[Any, Any], ...]:
    """The project's own requests, then those of third parties."""
    return REQUESTS + third_parties().requests


def _new(declared: Iterable[Any], own: Iterable[Any], theirs: dict[str, Any]) -> dict[str, Any]:
    """The declared rows that are new, by name. Raises ConfigError for a name that means something else already."""
    known = {row.name: row for row in own} | theirs
    found: dict[str, Any] = {}
    for row in declared:
        before = _known(row, known | found)
        if before is None:
            found[row.name] = row
        elif before != row:
            raise ConfigError(f"its {type(row).__name__.lower()} {row.name} differs from the one that is known already")
    return found


def _known(row: Any, known: dict[str, Any]) -> Any:
    """The known row that a row's name means, if any: a per-service row means the names of all services."""
    if row.name in known:
        return known[row.name]
    general = known.get("{service}/" + row.name.partition("/")[2])
    return None if general is None else general.of(row.name.partition("/")[0])
