"""`cocoro top`: services, their cost, topics, rates and losses, live. Collected here, drawn by `top_view`."""

from __future__ import annotations

import asyncio
import os
import sys
import time
from contextlib import suppress
from functools import partial
from typing import Annotated, Any

import msgspec
import psutil
import typer

from apps.cli import exits
from apps.cli.interrupt import elapsed, interrupt_event
from apps.cli.link import MeshLink, joined
from apps.cli.options import JsonOption, RobotChoice, RobotOption, ThroughOption
from apps.cli.output import print_json
from apps.cli.status import missing
from apps.cli.top_view import Screen, print_report
from cocoro.component import Component
from cocoro.errors import CocoroError
from cocoro.installed import topic_named
from cocoro.keys import matches
from cocoro.messages import ClockOffset, Health, Message, TopicHealth
from cocoro.topics import ANY, BASE_STATE, CLOCK, HEALTH, LATCH, OFFSET, PLAN, TASK, Topic
from deploy import processes
from deploy.processor import ProcessorUse, ProcessorWatch
from deploy.rates import meant_hz
from deploy.survey import REPLAYED, expected, within

FIRST_S = 2.5
"""Longest wait for the health of every live service; each publishes it once a second of the robot's time."""
UNREPORTED_S = 3.0
"""A live service that publishes no health for this long of the robot's time is late, or hangs."""
NEWS: dict[str, Topic[Any]] = {"clock": CLOCK, "task": TASK, "plan": PLAN, "latch": LATCH, "base": BASE_STATE}


app = typer.Typer()


@app.command()
def top(
    once: Annotated[bool, typer.Option("--once", help="Show it once; exit code 1 when something is missing.")] = False,
    every: Annotated[float, typer.Option(min=0.1, max=60.0, metavar="S", help="Time between updates.")] = 1.0,
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Services and topics, live: cpu, memory, rates against nominal, ages; what was skipped, lost, rejected.

    Ctrl-C ends it. Counts are since the start; a value that is wrong now, or grows and should not, is red. LATE is for
    a service the share of its loop's periods that just passed without a step, for a topic the commands that came too
    late to be obeyed. SKIPPED are messages that a newer one replaced because the reader was too slow, which is no
    loss.
    """
    sys.exit(asyncio.run(show_top(RobotChoice(robot, site), once, json, every)))


async def show_top(choice: RobotChoice, once: bool, as_json: bool, every_s: float) -> int:
    """Shows the report until interrupted, or once; the exit code of `once` is 1 when an expected service is missing."""
    async with joined(choice) as link:
        watch = MeshWatch(link)
        await watch.first()
        if once:
            report = watch.report()
            _print(report, as_json)
            return exits.FAILED if missing(report) else exits.DONE
        with interrupt_event() as end:
            if as_json or not sys.stdout.isatty():
                while not end.is_set():
                    _print(watch.report(), as_json)
                    await elapsed(end, every_s)
            else:
                with Screen() as screen:
                    while not end.is_set():
                        screen.show(watch.report())
                        await elapsed(end, every_s)
    return exits.DONE


def _print(report: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(report)
    else:
        print_report(report)


class MeshWatch:
    """Collects the health of all services; `report` returns the newest as data."""

    def __init__(self, link: MeshLink) -> None:
        self._link = link
        self._alive: set[str] = set()
        self._health: dict[str, Health] = {}
        self._heard_s: dict[str, float] = {}
        self._news: dict[str, Message] = {}
        self._offsets: dict[str, ClockOffset] = {}
        self._before: dict[tuple[str, str, str], int] = {}
        """Counts of the last report, by reader, key and name of the count."""
        self._loops: dict[str, tuple[float, int, float]] = {}
        """By service: uptime and overruns at its last health, and the share of late periods in it."""
        self._processor = ProcessorWatch()
        self._resolved: dict[str, Any] = {}
        self._changed = asyncio.Event()
        self._machine()  # the CPU share is measured between two calls
        link.inbox(HEALTH.of("*")).add(lambda _key, health: self._on_health(health))
        for what, topic in NEWS.items():
            link.inbox(topic).add(partial(self._on_news, what))
        link.on(OFFSET.of(ANY), self._on_offset)
        link.watch_alive(self._on_alive)

    async def first(self) -> None:
        """Waits for the health of every live service, at most FIRST_S."""
        self._alive |= set(await self._link.alive())
        there = self._alive | self._link.replayed()
        await within(FIRST_S, lambda: there | self._alive <= set(self._health), self._changed)

    def _on_alive(self, service: str, alive: bool) -> None:
        (self._alive.add if alive else self._alive.discard)(service)
        self._changed.set()

    def _on_health(self, health: Health) -> None:
        self._health[health.service] = health
        self._heard_s[health.service] = time.monotonic()
        self._changed.set()

    def _on_offset(self, offset: ClockOffset) -> None:
        self._offsets[offset.host] = offset

    def _on_news(self, what: str, _key: str, message: Message) -> None:
        self._news[what] = message

    # --- the report -------------------------------------------------------------------------------

    def _machine(self) -> dict[str, Any]:
        """Number of cores, their used share since the last call (None where /proc is not readable), and who of the
        robot's processes of this machine waited for a processor meanwhile."""
        try:
            used = psutil.cpu_percent() / 100
        except (psutil.Error, OSError):
            used = None
        use: ProcessorUse | None = None
        with suppress(OSError, CocoroError):
            use = self._processor.take({by.name: by.pid for by in self._link.run_dir.claims().values()})
        return {
            "cores": os.cpu_count() or 1,
            "cpu_share": used,
            "waited": {} if use is None else use.waited,
            "starved": "" if use is None else use.words,
        }

    def report(self) -> dict[str, Any]:
        resolved = self._resolved = self._link.run_dir.resolved()
        rows = _rows(resolved)
        names = dict.fromkeys([*expected(resolved), *sorted(self._alive | set(self._health))])
        ordered = sorted(names, key=lambda name: _place(name, rows, list(names)))
        return {
            "robot": self._link.robot,
            "profile": resolved.get("name", ""),
            "machine": self._machine(),
            **{what: msgspec.to_builtins(self._news.get(what)) for what in NEWS},
            "clocks": [msgspec.to_builtins(self._offsets[host]) for host in sorted(self._offsets)],
            "services": [self._service(name, rows.get(name)) for name in ordered],
            "topics": self._topics(),
        }

    def _service(self, name: str, row: Component | None) -> dict[str, Any]:
        health, heard_s = self._health.get(name), self._heard_s.get(name)
        silent_s = None if heard_s is None else time.monotonic() - heard_s
        alive = name in self._alive
        replayed = health is None and self._link.unheard(name) == REPLAYED
        late = silent_s is None or silent_s * self._clock_rate > UNREPORTED_S
        unreported = alive and not replayed and self._clock_goes and late
        state = REPLAYED if replayed else "no report" if unreported else "" if health is None else health.state
        return {
            "service": name,
            "process": row.name if row is not None else name,
            "alive": alive,
            "state": state if alive else self._link.unheard(name),
            "silent_s": silent_s,
            "cpu_budget": None if row is None else row.cpu_share,
            "rss_budget_mb": None if row is None else row.rss_mb,
            "late_share": self._late_share(health),
            "health": None if health is None else _without_topics(health),
        }

    @property
    def _clock_rate(self) -> float:
        clock = self._news.get("clock")
        return 1.0 if clock is None else getattr(clock, "rate", 1.0)

    @property
    def _clock_goes(self) -> bool:
        return not getattr(self._news.get("clock"), "paused", False)

    def _late_share(self, health: Health | None) -> float | None:
        """Share of a service's loop's periods that passed without a step, because it was late, since the last report
        that had another health; None without a loop."""
        loop = None if health is None else max(health.loops, key=lambda loop: loop.rate_hz, default=None)
        if health is None or loop is None:
            return None
        uptime_s, overruns, share = self._loops.get(health.service, (0.0, 0, 0.0))
        passed_s = health.uptime_s - uptime_s
        if passed_s < 0 or overruns > loop.overruns:  # it was restarted
            uptime_s, overruns, passed_s = 0.0, 0, health.uptime_s
        if passed_s > 0:
            late = loop.overruns - overruns
            share = late / max(late + loop.rate_hz * passed_s, 1.0)
            self._loops[health.service] = (health.uptime_s, loop.overruns, share)
        return share

    def _topics(self) -> list[dict[str, Any]]:
        """Every key that a service publishes, or reads although nothing publishes it; each with its readers."""
        sent: dict[str, tuple[str, TopicHealth]] = {}
        read: list[tuple[str, TopicHealth]] = []
        for service, health in self._health.items():
            if service in self._alive or self._link.unheard(service) == REPLAYED:
                for topic in health.topics:
                    if topic.direction == "out":
                        sent[topic.key] = (service, topic)
                    else:
                        read.append((service, topic))
        keys = list(sent)
        keys += dict.fromkeys(topic.key for _, topic in read if not any(matches(topic.key, key) for key in sent))
        now = {(service, topic.key, what): count(topic, what) for service, topic in read for what in COUNTS}
        found = [self._topic(key, sent.get(key), read) for key in keys]
        self._before = now
        return sorted(found, key=lambda topic: topic["topic"])

    def _topic(
        self, key: str, sent: tuple[str, TopicHealth] | None, read: list[tuple[str, TopicHealth]]
    ) -> dict[str, Any]:
        name = key.removeprefix(f"{self._link.robot}/")
        topic = topic_named(name)
        readers = [
            {
                "service": service, "rate_hz": health.rate_hz, "age_s": health.age_s,
                **{what: count(health, what) for what in COUNTS},
                "growing": any(
                    count(health, what) > self._before.get((service, health.key, what), count(health, what))
                    for what in COUNTS
                ),
                "last_error": health.last_error,
            }
            for service, health in read if matches(health.key, key) or health.key == key
        ]  # fmt: skip
        publisher = sent[0] if sent is not None else ", ".join(processes.publishers(topic)) if topic is not None else ""
        return {
            "topic": name,
            "publisher": publisher,
            "published": sent is not None,
            "count": sent[1].count if sent is not None else 0,
            "rate_hz": sent[1].rate_hz if sent is not None else 0.0,
            "nominal_hz": meant_hz(topic, self._resolved),
            "age_s": sent[1].age_s if sent is not None else None,
            "max_age_s": None if topic is None else topic.max_age_s,
            "readers": readers,
        }


COUNTS = ("skipped", "lost", "rejected", "expired")


def count(health: TopicHealth, what: str) -> int:
    """A count of a reader's health; here expired messages do not count as rejected."""
    value: int = getattr(health, what)
    return value - health.expired if what == "rejected" else value


def _place(name: str, rows: dict[str, Component], names: list[str]) -> tuple[int, bool, int]:
    """Sort key: services of one process stand together, after the one that has the process's name."""
    row = rows.get(name)
    first = min((names.index(other) for other in names if row is not None and rows.get(other) is row), default=0)
    return (names.index(name) if row is None else first), row is not None and row.name != name, names.index(name)


def _without_topics(health: Health) -> dict[str, Any]:
    data: dict[str, Any] = msgspec.to_builtins(health)
    del data["topics"]
    return data


def _rows(resolved: dict[str, Any]) -> dict[str, Component]:
    """The component of each service, from the profile's components first, then from all that are installed."""
    known = {row.name: row for row in processes.components()}
    started = [known[name] for name in resolved.get("processes", ()) if name in known]
    found: dict[str, Component] = {}
    for row in (*started, *known.values()):
        for service in (row.name, *row.services):  # a process may be a service besides its own
            found.setdefault(service, row)
    return found
