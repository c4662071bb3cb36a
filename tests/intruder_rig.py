"""What each principal of the laboratory's site may not do, from the tables of topics, requests and rights: a topic or
request that is added brings attempts of its own."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from bench.site_lab import BRAIN, ROBOT, files_of
from cocoro.installed import all_requests, all_topics
from cocoro.keys import alive_key, asker_key, matches, recorder_key
from cocoro.topics import Request, Topic
from deploy.site import plan
from deploy.site.plan import Site
from deploy.site.rights import Rights, rights

PRINCIPALS = ("eve", "ada", "bob", BRAIN)
"""A viewer, an operator, an author, and who has stolen the brain's certificate."""
MARK = "intruder-"
GHOST = "ghost"
"""A service that there is not: its token shows when it comes through."""
LOGGED = {
    "put": "Put",
    "serve": "Declare Queryable",
    "ask": "Query",
    "show": "Liveliness Token",
    "hear": "Declare Subscriber",
}
"""What the gateway's log calls each attempt."""


class Attempt(NamedTuple):
    """One kind of thing that a principal may not do, on all keys of a row of the tables that are not its own."""

    who: str
    do: str
    row: str
    keys: tuple[str, ...]

    @property
    def mark(self) -> str:
        """Is in what is sent, and in nothing else."""
        return f"{MARK}{self.who}-{self.do}-{self.row}."

    def __str__(self) -> str:
        return f"{self.who}-{self.do}-{self.row.replace('{service}', 'each')}"


@cache
def site() -> Site:
    """The plan of the laboratory's site."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files_of("10.77.0.1", {"scene": "paper"}).items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        return plan.read(Path(folder))


def attempts() -> list[Attempt]:
    """All of them, by principal, kind and row."""
    return [one for who in PRINCIPALS for one in _of(who, rights(site(), who, ROBOT))]


def allowed(who: str) -> list[str]:
    """The keys of topics that a principal may publish on."""
    mine = rights(site(), who, ROBOT).puts
    return [key for topic in all_topics() for key in _keys(topic) if _in(mine, key)]


def _of(who: str, may: Rights) -> Iterable[Attempt]:
    topics, requests = all_topics(), all_requests()
    newest = [topic for topic in topics if topic.slow]
    kinds: tuple[tuple[str, Iterable[Topic[Any] | Request[Any, Any]], frozenset[str]], ...] = (
        ("put", topics, may.puts),
        ("serve", (*requests, *newest), may.answers),
        ("ask", (*requests, *newest), may.asks),
        ("hear", topics, may.hears - may.never_hears),
    )
    for do, rows, own in kinds:
        for row in rows:
            if keys := tuple(key for key in _keys(row) if not _in(own, key)):
                yield Attempt(who, do, row.name, keys)
    tokens = {"alive": alive_key, "recorder": recorder_key, "asker": asker_key}
    for name, key_of in tokens.items():
        if keys := tuple(key for one in (*services(), GHOST) if not _in(may.shows, key := key_of(ROBOT, one))):
            yield Attempt(who, "show", name, keys)


def _keys(row: Topic[Any] | Request[Any, Any]) -> list[str]:
    return [row.of(one).key(ROBOT) for one in services()] if row.per_service else [row.key(ROBOT)]


def _in(own: Iterable[str], key: str) -> bool:
    return any(matches(keyexpr, key) for keyexpr in own)


@cache
def services() -> tuple[str, ...]:
    """The names of all services and processes of the site."""
    found = [node for host in site().hosts for one in site().share(host) for node in (one.name, *one.services)]
    return tuple(dict.fromkeys(found))
