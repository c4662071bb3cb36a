"""A site with a hub and many robots, and what each of its hosts says and hears: for `bench.scale`.

Each robot has two hosts: one with its body and everything but planning, and a brain host that commands it from afar, by
way of the hub. What they publish, read, serve and declare is what their components declare, at the rates of the topic
table; a message has as many bytes as the median one of its topic in the golden capture.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from datetime import datetime
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from bench.suite import ROOT
from cocoro.component import Component
from cocoro.keys import alive_key
from cocoro.topics import ABOUT, ANY, ESTOP, FRAME, HEALTH, TRUTH, Topic
from cocoro.topics import CLOCK as CLOCK_TOPIC
from deploy.processes import named
from deploy.site import authority, place, plan
from deploy.site.plan import Site

GOLDEN = ROOT / "tests" / "golden" / "fetch.mcap"
HUB, OPERATOR, VIEWER = "hub", "ada", "eve"
BODY = ("capture", "sim", "perception", "executive")
BRAIN = ("planning",)
LEFT_OUT = {topic.name for topic in (FRAME, CLOCK_TOPIC, TRUTH)}
"""Frames stay on the robot's machine, and a real robot has no simulator."""
PERIOD_NS = 1_000_000_000
"""Of the schedule: after it everything comes again."""


def robot(number: int) -> str:
    return f"r{number}"


def body(number: int) -> str:
    return f"body{number}"


def brain(number: int) -> str:
    return f"brain{number}"


def text(robots: int, port: int) -> str:
    """The plan of a site with robots 1, 2, ...: the operator deals with all of them, the viewer with the first."""
    lines = ['name = "fleet"']
    for number in range(1, robots + 1):
        lines += [f"[robot.{robot(number)}]", 'profile = "sim"']
    lines += [f"[host.{HUB}]", 'role = "hub"', f'listen = ["tls/127.0.0.1:{port}"]']
    for number in range(1, robots + 1):
        for name, role, processes in ((body(number), "robot", BODY), (brain(number), "brain", BRAIN)):
            listed = ", ".join(f'"{process}"' for process in processes)
            lines += [f"[host.{name}]", f'role = "{role}"', f'robot = "{robot(number)}"', f"processes = [{listed}]"]
    lines += [f"[person.{OPERATOR}]", 'role = "operator"']
    lines += [f"[person.{VIEWER}]", 'role = "viewer"', f'robots = ["{robot(1)}"]']
    return "\n".join(lines) + "\n"


def make(folder: Path, robots: int, port: int, now: datetime) -> Site:
    """Writes the plan, and issues everybody's certificate."""
    folder.mkdir(mode=0o700)
    (folder / place.PLAN).write_text(text(robots, port), encoding="utf-8")
    site = plan.read(folder)
    authority.init(folder, now)
    for name in site.principals:
        authority.issue(folder, site.role(name), name, now, addresses=site.addresses(name))
    return site


class Share(NamedTuple):
    """What one host's processes say and hear, keys without the robot's name."""

    publishes: tuple[Topic[Any], ...]
    """Topics with a rate: what is published on change alone is left out."""
    reads: tuple[str, ...]
    serves: tuple[str, ...]
    shows: tuple[str, ...]
    """Liveliness tokens."""
    records: bool

    @property
    def stops(self) -> tuple[str, ...]:
        """The keys of the emergency stop that it answers."""
        return tuple(key for key in self.serves if key.endswith(ESTOP.of("").name))


def share(components: Iterable[Component]) -> Share:
    """What components say and hear according to their declarations."""
    publishes: dict[str, Topic[Any]] = {}
    reads: dict[str, None] = {}
    serves: dict[str, None] = {}
    shows: dict[str, None] = {}
    records = False
    for component in components:
        nodes = dict.fromkeys((component.name, *component.services))
        own = [*component.all_publishes(), *(HEALTH.of(node) for node in nodes)]
        publishes |= {row.name: row for row in own if row.rate_hz and row.name not in LEFT_OUT}
        rows = (row.of(ANY) if row.per_service else row for row in component.reads)
        reads |= dict.fromkeys(row.name for row in rows if row.name not in LEFT_OUT)
        asked = [*component.all_serves(), *(ABOUT.of(node) for node in nodes)]
        serves |= dict.fromkeys(row.name for row in asked)
        shows |= dict.fromkeys(alive_key("", node).removeprefix("/") for node in nodes)
        records |= component.records
    return Share(tuple(publishes.values()), tuple(reads), tuple(serves), tuple(shows), records)


def share_of(site: Site, host: str) -> Share:
    """What the processes of a host say and hear, its gateway left out."""
    return share(named(process) for process in site.host(host).processes)


class Due(NamedTuple):
    """A message of the schedule."""

    at_ns: int
    """Within the period."""
    topic: int
    """Index of the topic."""


def schedule(rates_hz: Iterable[float], phase_ns: int = 0) -> list[Due]:
    """When within a second each topic is due: as often as its rate says, evenly, all from the same phase on."""
    found = []
    for index, rate_hz in enumerate(rates_hz):
        count = round(rate_hz)
        found += [Due((phase_ns + number * PERIOD_NS // count) % PERIOD_NS, index) for number in range(count)]
    return sorted(found)


@cache
def sizes() -> dict[str, int]:
    """Bytes of a topic's median message in the golden capture, by name."""
    from mcap.reader import make_reader

    found: dict[str, list[int]] = defaultdict(list)
    with GOLDEN.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            found[channel.topic.partition("/")[2]].append(len(message.data))
    return {name: round(median(lengths)) for name, lengths in found.items()}


def size(topic: str) -> int:
    """Bytes of a message: of its topic in the golden capture, or of the same kind of another service."""
    known = sizes()
    if topic in known:
        return known[topic]
    kind = topic.partition("/")[2]
    return round(median(length for name, length in known.items() if name.partition("/")[2] == kind))
