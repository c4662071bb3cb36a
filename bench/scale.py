"""Many robots on one hub: `python -m bench scale [--robots 1,5,10,25,50] [--charts DIR]`.

A site's hub, its real gateway process with the rules compiled for all robots, mutual TLS over loopback; and for each
robot two hosts (`bench.scale_site`), whose traffic a few worker processes make (`bench.scale_worker`) without physics
or frames. Two arrangements: every host's session connects straight to the hub, or to a gateway of its own that does.
An operator at the hub sees each robot's base and task, and a viewer everything of the first robot.

The workers need the same cores as the hub. So processor time per message is what a figure here says about the hub;
latencies and losses are good as long as the cores are not used up, which each row of the table says. Each process is a
session of its own, so that Linux shares the cores out between them, and the generators do not take the hub's time.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from bench import page, scale_site
from bench.bus import free_port
from bench.report import Chart, Report, Series, Table, number, percentile
from bench.scale_fleet import FLEET_STOPS, LINKED_S, PATIENCE_S, RESTART_S, STOPS, Fleet, Worker, fleet
from bench.scale_site import VIEWER, Share
from bench.trials import number_of
from cocoro.errors import ConfigError
from cocoro.keys import matches
from cocoro.topics import BASE_STATE, TASK
from deploy.site.plan import Site

ARRANGEMENTS = {True: "straight to the hub", False: "a gateway each"}


def numbers(text: str) -> list[int]:
    return [number_of(part) for part in text.split(",")]


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robots", type=numbers, help="numbers of robots, with commas (1,5,10,25,50)")
    parser.add_argument("--seconds", type=number_of, help="of each measurement (8)")
    parser.add_argument("--charts", type=Path, metavar="DIR", help="draws the curves into DIR/scale-NAME.png")


class Row(NamedTuple):
    """What one number of robots came to in one arrangement."""

    robots: int
    in_hz: float
    """Messages a second that reached the hub."""
    out_hz: float
    """Messages a second that left it."""
    out_bps: float
    """Payload, bit/s."""
    loss: float
    command_ms: tuple[float, ...]
    stop_ms: tuple[float, ...]
    fleet_stop_ms: tuple[float, ...]
    missed_acks: int
    hub_cpu: float
    """Share of one core."""
    hub_mb: float
    gateway_cpu: float | None
    gateway_mb: float | None
    busy: float
    """Share of all cores that everything on the machine used."""
    workers_cpu: float
    """Cores that the generators used."""
    late: float
    """Share of the messages that the generators did not send, since their time was 20 ms ago."""
    up_s: float
    """From the start of the hub's process until it listens."""
    restart_s: float | None
    """From the end of the hub's process until the operator hears every robot again."""

    @property
    def hub_us(self) -> float:
        """Processor time of the hub for a message that comes or goes."""
        return 1e6 * self.hub_cpu / (self.in_hz + self.out_hz)


class Traffic(NamedTuple):
    """What passed the hub according to what was sent."""

    came: int
    went: int
    went_bytes: int
    expected: int
    """Deliveries that the receivers count."""


def passed(site: Site, shares: Mapping[str, Share], sent: Mapping[str, int]) -> Traffic:
    """What had to pass the hub: each message comes once if anybody across the hub wants it, and goes once on each
    link at whose end somebody does."""
    came = went = went_bytes = expected = 0
    for host, share in shares.items():
        robot = site.hosts[host].robot
        others = [shares[name] for name, row in site.hosts.items() if row.robot == robot and name != host]
        for topic in share.publishes:
            count = sent.get(topic.key(robot), 0)
            reads = [sum(matches(name, topic.name) for name in theirs.reads) + theirs.records for theirs in others]
            persons = (topic in (BASE_STATE, TASK)) + (robot in (site.persons[VIEWER].robots or ()))
            links = sum(map(bool, reads)) + persons
            came += count * bool(links)
            went += count * links
            went_bytes += count * links * scale_site.size(topic.name)
            expected += count * (sum(reads) + persons)
    return Traffic(came, went, went_bytes, expected)


def row_of(fleet: Fleet, found: dict[str, Any], up_s: float, restart_s: float | None) -> Row:
    sent: Counter[str] = Counter()
    for one in found["spoken"]:
        sent.update(one["sent"])
    through = passed(fleet.site, fleet.shares, sent)
    took_ns = [ns for one in found["hosts"] for ns in one["took_ns"]]
    got = len(took_ns) + sum(sum(one["heard"].values()) + sum(one["recorded"].values()) for one in found["hosts"])
    got += sum(sum(heard.values()) for heard in found["persons"].values())
    acks = sum(len(share.stops) for share in fleet.shares.values())
    each = acks // len(fleet.robots)
    missed = STOPS * each - sum(stop["answers"] for stop in found["stops"])
    missed += FLEET_STOPS * acks - sum(stop["answers"] for stop in found["fleet"])
    seconds = found["seconds"]
    late = sum(one["late"] for one in found["spoken"])
    real = fleet.gateway is not None
    return Row(
        robots=len(fleet.robots),
        in_hz=through.came / seconds, out_hz=through.went / seconds, out_bps=8 * through.went_bytes / seconds,
        loss=1.0 - got / through.expected,
        command_ms=tuple(ns / 1e6 for ns in took_ns),
        stop_ms=tuple(stop["took_ns"] / 1e6 for stop in found["stops"]),
        fleet_stop_ms=tuple(stop["took_ns"] / 1e6 for stop in found["fleet"]),
        missed_acks=missed,
        hub_cpu=found["used"][0], hub_mb=found["memory"][0],
        gateway_cpu=found["used"][1] if real else None, gateway_mb=found["memory"][1] if real else None,
        busy=found["busy"], workers_cpu=sum(one["cpu_s"] / one["took_s"] for one in found["spoken"]),
        late=late / max(1, sent.total() + late),
        up_s=up_s, restart_s=restart_s,
    )  # fmt: skip


def measure(chosen: argparse.Namespace, report: Report) -> None:
    counts = sorted({*(chosen.robots or ([1, 5] if chosen.short else [1, 5, 10, 25, 50]))})
    seconds = chosen.seconds or (4 if chosen.short else 8)
    rows: dict[bool, list[Row]] = {direct: [] for direct in ARRANGEMENTS}
    hubs: dict[int, dict[str, float]] = {}
    for robots in counts:
        with tempfile.TemporaryDirectory(prefix="scale") as name:
            folder = Path(name)
            port = free_port()
            site = scale_site.make(folder / "site", robots, port, datetime.now(UTC))
            hubs[robots] = opened(folder, site, port)
            report.say(f"{robots} robots: {hubs[robots]}")
            for direct, how in ARRANGEMENTS.items():
                place = folder / ("direct" if direct else "gateways")
                place.mkdir()
                with fleet(place, site, robots, direct=direct) as (up, up_s):
                    try:
                        up.link()
                    except ConfigError as error:
                        report.notes.append(f"{robots} robots, {how}: {error} within {LINKED_S:g} s")
                        report.say(report.notes[-1])
                        continue
                    row = row_of(up, up.measure(seconds), up_s, None)
                    rows[direct].append(row._replace(restart_s=up.restart()))
                report.say(f"{robots} robots, {how}: {', '.join(cells(rows[direct][-1]))}")
    tell(report, rows, hubs)
    if chosen.charts is not None:
        for chart in report.charts:
            page.draw(chart, chosen.charts / f"scale-{chart.name}.png")


def opened(folder: Path, site: Site, port: int) -> dict[str, float]:
    given = {"as": "hub", "site": str(site.folder), "run": str(folder / "opened"), "port": port}
    worker = Worker(given, folder / "opened.log")
    try:
        return {name: float(value) for name, value in worker.answer().items()}
    finally:
        worker.process.wait(PATIENCE_S)


HEAD = [
    "robots", "in, out (1/s)", "out (Mbit/s)", "lost (%)", "command, median, 99th (ms)", "stop of one (ms)",
    "stop of all, last answer (ms)", "answers missed", "hub (% of a core)", "hub (us a message)", "hub (MB)",
    "gateway (% of a core)", "gateway (MB)", "generators (cores)", "machine busy (%)", "not sent in time (%)",
    "hub up (s)", "all linked again (s)",
]  # fmt: skip


def cells(row: Row) -> list[str]:
    return [
        str(row.robots),
        f"{number(row.in_hz)}, {number(row.out_hz)}",
        number(row.out_bps / 1e6),
        number(100 * row.loss),
        f"{number(mid(row.command_ms))}, {number(percentile(row.command_ms, 99))}",
        f"{number(mid(row.stop_ms))}, {number(max(row.stop_ms))}",
        f"{number(mid(row.fleet_stop_ms))}, {number(max(row.fleet_stop_ms))}",
        str(row.missed_acks),
        number(100 * row.hub_cpu),
        number(row.hub_us),
        number(row.hub_mb),
        "" if row.gateway_cpu is None else number(100 * row.gateway_cpu),
        "" if row.gateway_mb is None else number(row.gateway_mb),
        number(row.workers_cpu),
        number(100 * row.busy),
        number(100 * row.late),
        number(row.up_s),
        f"not within {RESTART_S - 2}" if row.restart_s is None else number(row.restart_s),
    ]


def mid(values: Sequence[float]) -> float:
    return percentile(values, 50)


def tell(report: Report, rows: dict[bool, list[Row]], hubs: dict[int, dict[str, float]]) -> None:
    for direct, how in ARRANGEMENTS.items():
        if not rows[direct]:
            continue
        report.tables.append(Table(f"Each host {how}", HEAD, [cells(row) for row in rows[direct]]))
        last = rows[direct][-1]
        report.value(f"{last.robots} robots, {how}: a command by way of the hub", last.command_ms, "ms")
        report.value(f"{last.robots} robots, {how}: hub's processor time a message", [last.hub_us], "us")
        if len(rows[direct]) > 1:
            first = rows[direct][0]
            each = (last.hub_mb - first.hub_mb) / (last.robots - first.robots)
            report.value(f"{how}: hub's memory a robot", [each], "MB")
    head = ["robots", "site read (s)", "rules compiled (s)", "router opened (s)", "rules (kB)"]
    names = ("read_cpu_s", "compile_cpu_s", "open_s")
    report.tables.append(
        Table(
            "The hub's rules",
            head,
            [
                [str(robots), *(number(found[name]) for name in names), number(found["rules_bytes"] / 1e3)]
                for robots, found in hubs.items()
            ],
        )
    )
    report.charts += charts(rows)


def charts(rows: dict[bool, list[Row]]) -> list[Chart]:
    def chart(name: str, title: str, unit: str, **series: Any) -> Chart:
        lines = []
        for what, value in series.items():
            for direct, how in ARRANGEMENTS.items():
                if points := [(float(row.robots), *value(row)) for row in rows[direct]]:
                    lines.append(Series(f"{what.replace('_', ' ')}, {how}", points))
        return Chart(name, title, "robots", unit, lines, log_y=unit == "ms")

    def one(value: float) -> tuple[float, float, float]:
        return value, value, value

    def spread(values: Sequence[float]) -> tuple[float, float, float]:
        return mid(values), min(values), percentile(values, 99)

    return [
        chart("hub", "The hub's processor time", "% of a core", hub=lambda row: one(100 * row.hub_cpu)),
        chart("memory", "The hub's own memory", "MB", hub=lambda row: one(row.hub_mb)),
        chart(
            "command", "A command by way of the hub, median to 99th", "ms", command=lambda row: spread(row.command_ms)
        ),
        chart("stop", "Emergency stop until the last answer", "ms", of_all=lambda row: spread(row.fleet_stop_ms)),
    ]
