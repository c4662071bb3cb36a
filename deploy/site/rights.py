"""What each principal of a site may do on the mesh: by its role, the topic table and the components' declarations.

A host may do what the components that the plan puts there declare: so only the host that runs planning may command
wheels and arms. A person may do what his role says:

viewer    hears everything, asks what only looks, and stops.
operator  a viewer who also gives tasks, resets, relaxes and calibrates.
author    a viewer who also publishes and serves under a name of his own.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from cocoro.component import Component
from cocoro.installed import all_requests, all_topics
from cocoro.keys import alive_key, asker_key, matches, recorder_key
from cocoro.topics import (
    ABOUT,
    ANY,
    CLOCK,
    EXCHANGES,
    HEALTH,
    OFFSET,
    RUN,
    STEPS,
    TIME,
    TOPICS,
    TRUTH,
    Request,
    Right,
    Topic,
)
from deploy.site.component import gateway_of
from deploy.site.plan import Site
from deploy.site.roles import Role

OF_PERSONS: dict[Role, tuple[Right, ...]] = {
    "viewer": ("see", "stop"),
    "operator": ("see", "stop", "operate"),
    "author": ("see", "stop"),
}
"""The requests that a person of each role may send, by their `right`."""


class Rights(NamedTuple):
    """Sets of key expressions, by what may be done with their keys."""

    puts: frozenset[str] = frozenset()
    """Publish on them."""
    hears: frozenset[str] = frozenset()
    """Subscribe to them."""
    never_hears: frozenset[str] = frozenset()
    """Exceptions of `hears`."""
    asks: frozenset[str] = frozenset()
    """Send requests, and ask for a slow topic's newest message."""
    answers: frozenset[str] = frozenset()
    """Serve them."""
    shows: frozenset[str] = frozenset()
    """Declare liveliness tokens."""
    watches: frozenset[str] = frozenset()
    """Hear of liveliness tokens."""

    def __or__(self, other: Rights) -> Rights:
        """What both together may do; what one never hears is heard when the other hears it."""
        both = Rights(*(mine | theirs for mine, theirs in zip(self, other, strict=True)))
        heard = frozenset(key for key in both.never_hears if self.may_hear(key) or other.may_hear(key))
        return both._replace(never_hears=both.never_hears - heard)

    def narrowed(self, keys: Iterable[str]) -> Rights:
        """Those of these keys that the rights are for, and no others."""
        kept = Rights(*(frozenset(key for key in keys if any(matches(one, key) for one in mine)) for mine in self))
        return kept._replace(never_hears=self.never_hears)

    def may_ask(self, key: str) -> bool:
        return any(matches(keyexpr, key) for keyexpr in self.asks)

    def may_hear(self, key: str) -> bool:
        return key not in self.never_hears and any(matches(keyexpr, key) for keyexpr in self.hears)


def rights(site: Site, name: str, robot: str) -> Rights:
    """What a principal may do with a robot: nothing with one that is none of his. A hub does nothing but pass on.
    For a person who deals with all robots, `*` stands for each of them. Raises ConfigError for a name that the site
    does not have."""
    role = site.role(name)
    if not site.deals_with(name, robot) or role == "hub":
        return Rights()
    if name in site.hosts:
        return of_host(robot, site.share(name), simulated=site.profiles[robot].clock == "sim")
    return of_person(robot, role, name)


def of_host(robot: str, share: Iterable[Component], *, simulated: bool) -> Rights:
    """What a host may do that runs these components of a robot."""
    share = tuple(share)
    puts: set[Topic[Any]] = set()
    hears: set[str] = {CLOCK.key(robot)} if simulated else set()
    answers: set[str] = set()
    asks: set[str] = set()
    shows: set[str] = set()
    records = False
    for component in share:
        nodes = {component.name, *component.services}
        own: list[Topic[Any]] = [row.of(node) for node in nodes for row in (HEALTH, STEPS, EXCHANGES)]
        puts |= {*(row for row in component.all_publishes() if not row.local), *own}
        answers |= {row.key(robot) for row in component.all_serves()}
        answers |= {ABOUT.of(node).key(robot) for node in nodes}
        hears |= {_any(row).key(robot) for row in component.reads if not row.local}
        asks |= {_any(row).key(robot) for row in component.calls}
        shows |= {alive_key(robot, node) for node in nodes}
        if RUN in component.calls:
            shows |= {asker_key(robot, node) for node in nodes}
        if component.records:
            records = True
            hears.add(f"{robot}/**")
            shows |= {recorder_key(robot, service) for service in component.services}
    local = frozenset(row.key(robot) for row in all_topics() if row.local)
    made_here = any(TRUTH in component.all_publishes() for component in share)
    return Rights(
        puts=frozenset(row.key(robot) for row in puts),
        hears=frozenset(hears),
        never_hears=local | (frozenset() if made_here else frozenset({TRUTH.key(robot)})),
        asks=frozenset(asks),
        answers=frozenset(answers | {row.key(robot) for row in puts if row.askable}),
        shows=frozenset(shows),
        watches=frozenset({f"{robot}/**"} if records else {key(robot) for key in (alive_key, recorder_key, asker_key)}),
    )


def of_clocks(site: Site, robot: str) -> frozenset[str]:
    """The keys of a robot that pass a gateway even when its host's clock is wrong: those by which clocks are compared
    and by which everybody sees why it is refused."""
    nodes = [gateway_of(name).name for name, row in site.hosts.items() if row.robot == robot]
    rows = [row.of(node) for node in nodes for row in (TIME, OFFSET, HEALTH)]
    return frozenset({*(row.key(robot) for row in rows), *(alive_key(robot, node) for node in nodes)})


def of_person(robot: str, role: Role, name: str) -> Rights:
    """What a person may do with a robot."""
    allowed = OF_PERSONS[role]
    asks = {_any(row).key(robot) for row in all_requests() if row.right in allowed}
    asks |= {_any(row).key(robot) for row in TOPICS if row.askable}
    own = frozenset({f"{robot}/{name}/**"}) if role == "author" else frozenset()
    shows = {asker_key(robot)} if "operate" in allowed else set()
    return Rights(
        puts=own,
        hears=frozenset({f"{robot}/**"}),
        never_hears=frozenset(row.key(robot) for row in all_topics() if row.local),
        asks=frozenset(asks) | own,
        answers=own,
        shows=frozenset(shows) | own,
        watches=frozenset({f"{robot}/**"}),
    )


def _any(row: Topic[Any] | Request[Any, Any]) -> Topic[Any] | Request[Any, Any]:
    """A per-service row for any service, others as they are."""
    return row.of(ANY) if row.per_service else row
