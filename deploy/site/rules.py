"""Compiles a host's access rules for zenoh: who may do what on its gateway's links, which sizes and which rates.

Everything is denied that no rule allows, in both directions of each link. A link is known by the common name of the
certificate at its other end; all other processes of the same host, on Unix sockets, may do everything. A host that
passes on what others send (because they connect to it) may do for its neighbours what these others may do: those rules
hold against everybody else, and the host that passes on is trusted to have checked its own links.

Interest (which keys somebody wants to hear or to be asked about) is told to every principal of a robot: zenoh compares
the key expressions of declarations as they are, and `calliope/**` of a recorder is in no rule for a single key.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import reduce
from operator import or_
from typing import Any, NamedTuple

from cocoro.bus.base import Qos
from cocoro.installed import all_requests, all_topics
from cocoro.node import QUESTION_BYTES
from cocoro.topics import ANY, Request, Topic
from deploy.processes import components
from deploy.site.component import PREFIX, gateway_of
from deploy.site.plan import Site
from deploy.site.rights import Rights, rights

HEADROOM = 10.0
"""A key may be published this many times as often as its nominal rate: a network that stalls delivers what waited all
at once, and only a flood comes more often than that for long."""
UNTABLED_HZ = 1000.0
"""A topic without a nominal rate may be published at most this often. Events are not limited, since each of them
counts, nor are an author's own keys: one limit would hold for all of them together."""
ANSWER_BYTES = 8 * 1024 * 1024
"""Upper bound of an answer: a learned model is the largest."""
ZENOHS_SESSIONS, SESSIONS_EACH = 1000, 4
"""Sessions that a hub accepts: zenoh's default, and so many more for each principal. A site of 1,000 robots has
more hosts than the default, and each command of a person is a session."""
IN, OUT = "ingress", "egress"
EVERYTHING = (
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable",
    "liveliness_token", "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
LARGEST_BYTES = max(ANSWER_BYTES, *(topic.max_bytes for topic in all_topics())) + QUESTION_BYTES
"""A larger message is not put together from its fragments, so that it takes no memory, whoever sends it; with room for
what zenoh adds."""
LOCAL = "unixsock-stream"
ALL = ("**", "@cocoro/**")
"""No wildcard matches a chunk with '@', as the tokens of the mesh's members have it: they stay on their machine."""


class Rule(NamedTuple):
    """One allowed (or denied) kind of message on a principal's links, as zenoh has it."""

    principal: str
    flow: str
    """`ingress`: it sends this here; `egress`: it gets this from here."""
    messages: tuple[str, ...]
    keys: tuple[str, ...]
    allow: bool = True


def compiled(
    site: Site, host: str, names: Mapping[str, Iterable[str]], *, only: frozenset[str] | None = None
) -> dict[str, Any]:
    """The options of a host's router session, by path. `names` are the certificates' common names of each principal
    that are admitted; one without any is kept out. `only`: as in `table`."""
    rules = table(site, host, only=only)
    admitted = {name: sorted(names.get(name, ())) for name in dict.fromkeys(rule.principal for rule in rules)}
    admitted = {name: known for name, known in admitted.items() if known}
    rows = [(f"{index}", rule) for index, rule in enumerate(rules) if rule.principal in admitted]
    of: dict[str, list[str]] = {name: [] for name in admitted}
    for index, rule in rows:
        of[rule.principal].append(index)
    control = {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {"id": LOCAL, "messages": EVERYTHING, "flows": [IN, OUT], "permission": "allow", "key_exprs": ALL},
            *(
                {
                    "id": index,
                    "messages": rule.messages,
                    "flows": [rule.flow],
                    "permission": "allow" if rule.allow else "deny",
                    "key_exprs": rule.keys,
                }
                for index, rule in rows
            ),
        ],
        "subjects": [
            {"id": LOCAL, "link_protocols": [LOCAL]},
            *({"id": name, "cert_common_names": known} for name, known in admitted.items()),
        ],
        "policies": [
            {"rules": [LOCAL], "subjects": [LOCAL]},
            *({"rules": of[name], "subjects": [name]} for name in admitted),
        ],
    }
    more = ZENOHS_SESSIONS + SESSIONS_EACH * len(site.principals)
    robot = ANY if site.is_hub(host) else site.host(host).robot
    return {
        "access_control": control,
        **({"transport/unicast/max_sessions": more} if site.is_hub(host) else {}),
        "low_pass_filter": _sizes(robot),
        "downsampling": _rates(site, host),
        "transport/link/rx/max_message_size": LARGEST_BYTES,
        "qos/network": _events(robot),
    }


def table(site: Site, host: str, *, only: frozenset[str] | None = None) -> list[Rule]:
    """The rules that a host's gateway keeps, in the order of the plan. `only`: the keys that pass, where that is not
    all that the rights are for; interest in others may still be told."""
    found = []
    for name, full in neighbours(site, host).items():
        may = full if only is None else full.narrowed(only)
        interest = frozenset(f"{robot}/**" for robot in _shared(site, host, name))
        rows = (
            (IN, ("put",), may.puts),
            (OUT, ("declare_subscriber",), interest),
            (IN, ("declare_subscriber",), full.hears),
            (OUT, ("put",), may.hears),
            (IN, ("query",), may.asks),
            (OUT, ("reply", "declare_queryable"), may.asks),
            (OUT, ("query",), interest),
            (IN, ("reply", "declare_queryable"), may.answers),
            (IN, ("liveliness_token",), may.shows),
            (OUT, ("liveliness_query", "declare_liveliness_subscriber"), interest),
            (IN, ("liveliness_query", "declare_liveliness_subscriber"), full.watches),
            (OUT, ("liveliness_token",), may.watches),
        )
        found += [Rule(name, flow, messages, tuple(sorted(keys))) for flow, messages, keys in rows if keys]
        if may.never_hears:
            found.append(Rule(name, OUT, ("put",), tuple(sorted(may.never_hears)), allow=False))
    return found


def neighbours(site: Site, host: str) -> dict[str, Rights]:
    """The principals at the other ends of a host's links, and what may come and go there: what they may do
    themselves, and what those may do for whom they pass it on."""
    direct = site.connected(host) if site.host(host).listen else ()
    found = {}
    for name in dict.fromkeys((*direct, *site.connects(host))):
        robots = _shared(site, host, name)
        behind = _behind(site, name, host, robots) if name in site.hosts else ()
        found[name] = reduce(or_, (rights(site, one, robot) for one in (name, *behind) for robot in robots))
    return found


def _shared(site: Site, host: str, name: str) -> tuple[str, ...]:
    """The robots that both deal with. For a person who deals with all robots of a hub it is `*`, so that his rules are
    as many as those of one robot."""
    if name in site.persons and site.deals_with_all(name) and site.is_hub(host):
        return (ANY,)
    return site.robots_shared(host, name)


def _behind(site: Site, name: str, host: str, robots: Iterable[str]) -> tuple[str, ...]:
    """The principals that reach a host by way of `name`, and deal with one of these robots: others pass nothing on."""
    robots = tuple(robots)
    found: dict[str, None] = {}
    waiting = [name]
    while waiting:
        at = waiting.pop()
        for one in (*site.connected(at), *(site.connects(at) if at in site.hosts else ())):
            if one not in found and one not in (name, host) and any(site.deals_with(one, robot) for robot in robots):
                found[one] = None
                waiting += [one] if one in site.hosts else []
    return tuple(found)


def _sizes(robot: str) -> list[dict[str, Any]]:
    """Limits of sizes: a larger message is dropped where it arrives."""
    by_size: dict[tuple[str, int], list[str]] = {}
    for topic in all_topics():
        by_size.setdefault(("put", topic.max_bytes), []).append(_key(topic, robot))
    for request in all_requests():
        by_size.setdefault(("query", QUESTION_BYTES), []).append(_key(request, robot))
        by_size.setdefault(("reply", ANSWER_BYTES), []).append(_key(request, robot))
    return [
        {
            "id": f"size {kind} {size}",
            "link_protocols": ["tls"],
            "flows": [IN],
            "messages": [kind],
            "key_exprs": sorted(keys),
            "size_limit": size,
        }
        for (kind, size), keys in by_size.items()
    ]


def most_hz(topic: Topic[Any]) -> float | None:
    """How often a link may bring a topic's messages; None for events, which are not limited."""
    if topic.qos is Qos.EVENT:
        return None
    return topic.rate_hz * HEADROOM if topic.rate_hz else UNTABLED_HZ


def _rates(site: Site, host: str) -> list[dict[str, Any]]:
    """Limits of rates: a message that follows the last one of its key on the same link too soon is dropped where it
    arrives. A request with a wildcard counts as one of those that it reaches: a rule with a wildcard would count the
    requests to several services as one. A flood of stops is thinned as all requests are: the first one passes, and
    then one in each period.

    Requests (`Request.most_hz`) are limited where persons link. A link between hosts carries what several persons ask,
    and one of them must not have the others' requests dropped. A hub limits none, since zenoh counts all keys of a rule
    as one, and who asks fifty robots at once asks each of them once."""
    hub = site.is_hub(host)
    robot = ANY if hub else site.host(host).robot
    services = [service for component in components() for service in component.services]
    # At a hub one rule stands for the gateways of all hosts: each has a link of its own.
    services += (
        [f"{PREFIX}$*"] if hub else [gateway_of(name).name for name in site.hosts if site.deals_with(name, robot)]
    )
    puts, asked = [], []
    for topic in all_topics():
        freq = most_hz(topic)
        each = [topic.of(service) for service in services] if topic.per_service else [topic]
        puts += [{"key_expr": row.key(robot), "freq": freq} for row in each if freq is not None]
    if site.host(host).listen and not hub:
        for request in all_requests():
            alike = [request.of(service) for service in services] if request.per_service else [request]
            asked += [{"key_expr": row.key(robot), "freq": row.most_hz} for row in alike]
    return [
        {"id": f"rate {kind}", "link_protocols": ["tls"], "flows": [IN], "messages": [kind], "rules": rules}
        for kind, rules in (("put", puts), ("query", asked))
        if rules
    ]


def _events(robot: str) -> list[dict[str, Any]]:
    """An event waits for a receiver on this machine, but not for a link to another: zenoh's thread that has it would
    wait, and commands behind it. What a link does not carry is missing there, and shows by its number."""
    return [
        {
            "id": "events",
            "link_protocols": ["tls"],
            "flows": [OUT],
            "messages": ["put"],
            "key_exprs": sorted(_key(topic, robot) for topic in all_topics() if topic.qos is Qos.EVENT),
            "overwrite": {"congestion_control": "drop"},
        }
    ]


def _key(row: Topic[Any] | Request[Any, Any], robot: str) -> str:
    return (row.of(ANY) if row.per_service else row).key(robot)
