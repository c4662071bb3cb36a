"""Who may do what on which key of a robot: a site's access rules as one table that a person can check.

It is made from the same rights and limits as zenoh's rules are (`deploy.site.rules`), key by key.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from cocoro.installed import all_requests, all_topics
from cocoro.keys import alive_key, asker_key, matches, recorder_key
from cocoro.node import QUESTION_BYTES
from cocoro.topics import RUN
from deploy.site.plan import Site
from deploy.site.rights import Rights, rights
from deploy.site.rules import most_hz

TOPIC, REQUEST, TOKEN, OWN = "topic", "request", "token", "author's"
VERBS = {
    TOPIC: ("puts", "hears"),
    REQUEST: ("asks", "answers"),
    TOKEN: ("shows", "watches"),
    OWN: ("puts", "hears", "asks", "answers", "shows", "watches"),
}
"""What can be done with each kind of key. A slow topic's newest message is asked for by who hears it."""


class Row(NamedTuple):
    """One key, and what each principal may do with it."""

    key: str
    """Without the robot's name."""
    kind: str
    may: dict[str, tuple[str, ...]]
    """By principal: some of `puts`, `hears`, `asks`, `answers`, `shows`, `watches`; empty for nothing."""
    max_bytes: int | None = None
    max_hz: float | None = None
    """Limits of a link from another host; None where there is none."""


def matrix(site: Site, robot: str) -> list[Row]:
    """The rows of a robot, in the order of the topic table; then requests, tokens, and the keys of authors."""
    names = [name for name in site.principals if robot in site.robots_of(name)]
    may = {name: rights(site, name, robot) for name in names}
    hosts = [name for name in site.hosts if robot in site.robots_of(name) and not site.is_hub(name)]
    names = [name for name in names if not site.is_hub(name)]
    services = [service for name in hosts for service in _nodes(site, name)]
    rows = [
        Row(row.name, TOPIC, _may(may, row.key(robot), TOPIC), row.max_bytes, most_hz(row))
        for topic in all_topics()
        for row in _each(topic, services)
    ]
    rows += [
        Row(row.name, REQUEST, _may(may, row.key(robot), REQUEST), QUESTION_BYTES, request.most_hz)
        for request in all_requests()
        for row in _each(request, services)
    ]
    rows += [
        Row(key.partition("/")[2], TOKEN, _may(may, key, TOKEN))
        for key in (
            *(alive_key(robot, service) for service in services),
            *(recorder_key(robot, service) for service in services),
            *(asker_key(robot, asker) for asker in (*_askers(site, hosts), "asker")),
        )
    ]
    authors = [name for name in names if site.role(name) == "author"]
    rows += [Row(f"{name}/**", OWN, _may(may, f"{robot}/{name}/any", OWN)) for name in authors]
    return [row for row in rows if any({"puts", "answers", "shows"} & {*verbs} for verbs in row.may.values())]


def _askers(site: Site, hosts: list[str]) -> list[str]:
    """The services that ask for tasks."""
    return [service for name in hosts for one in site.share(name) if RUN in one.calls for service in one.services]


def _nodes(site: Site, host: str) -> list[str]:
    found = [node for one in site.share(host) for node in (*one.services, one.name)]
    return list(dict.fromkeys(found))


def _each(row: Any, services: Iterable[str]) -> list[Any]:
    return [row.of(service) for service in services] if row.per_service else [row]


def _may(may: dict[str, Rights], key: str, kind: str) -> dict[str, tuple[str, ...]]:
    """What each may do with a key."""
    found = {}
    for name, theirs in may.items():
        verbs = [verb for verb in VERBS[kind] if any(matches(keyexpr, key) for keyexpr in getattr(theirs, verb))]
        if "hears" in verbs and key in theirs.never_hears:
            verbs.remove("hears")
        found[name] = tuple(verbs)
    return found
