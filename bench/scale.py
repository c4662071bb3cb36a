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
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import psutil

from bench import page, scale_site
from bench.bus import free_port
from bench.report import Chart, Report, Series, Table, number, percentile
from bench.scale_site import HUB, OPERATOR, VIEWER, Share
from bench.trials import number_of
from cocoro.clock import steady_ns
from cocoro.errors import ConfigError
from cocoro.keys import matches
from cocoro.private import RUN_DIR
from cocoro.topics import BASE_STATE, TASK
from deploy.rundir import RunDir
from deploy.site.component import gateway_of
from deploy.site.plan import Site

NS = 1_000_000_000
WORKERS = 2
WARM_S = 2
RESTART_S = 20
"""Longest time for the restart of the hub; the robots speak for as long."""
AHEAD_NS = NS // 2
"""Time from the order to speak until the first message."""
DRAIN_S = 1.0
STOPS, FLEET_STOPS = 20, 5
PATIENCE_S = 120.0
LINKED_S = 60.0
ARRANGEMENTS = {True: "straight to the hub", False: "a gateway each"}


def numbers(text: str) -> list[int]:
    return [number_of(part) for part in text.split(",")]


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robots", type=numbers, help="numbers of robots, with commas (1,5,10,25,50)")
    parser.add_argument("--seconds", type=number_of, help="of each measurement (8)")
    parser.add_argument("--charts", type=Path, metavar="DIR", help="draws the curves into DIR/scale-NAME.png")


class Worker:
    """A process of `bench.scale_worker`."""

    def __init__(self, given: Mapping[str, Any], log: Path) -> None:
        with log.open("ab") as stream:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "bench.scale_worker", json.dumps(given)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream, text=True, start_new_session=True,
            )  # fmt: skip

    def answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise ConfigError("a worker of the bench has ended")
        found: dict[str, Any] = json.loads(line)
        return found

    def order(self, do: str, **more: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": do, **more}) + "\n")
        self.process.stdin.flush()

    def ask(self, do: str, **more: Any) -> dict[str, Any]:
        self.order(do, **more)
        return self.answer()

    def end(self) -> None:
        with contextlib.suppress(OSError):
            self.order("end")
        try:
            self.process.wait(5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


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


class Fleet:
    """A hub, its robots and persons, up. Make it with `fleet`."""

    def __init__(self, folder: Path, site: Site, robots: int, *, direct: bool) -> None:
        self.site = site
        self.robots = [scale_site.robot(number) for number in range(1, robots + 1)]
        self.direct = direct
        self._folder = folder
        self._port = int(site.hosts[HUB].listen[0].rpartition(":")[2])
        self.shares = {name: scale_site.share_of(site, name) for name in site.hosts if name != HUB}
        self.gateway: psutil.Process | None = None
        self.hub: psutil.Process | None = None
        self.workers: list[Worker] = []
        self.persons: dict[str, Worker] = {}

    def start(self) -> float:
        """Starts the hub, then everybody. Returns the seconds until the hub listened."""
        up_s = self.start_hub()
        real = [] if self.direct else [scale_site.body(1)]
        if real:
            self.gateway = self._gateway(real[0], self._folder / "run" / real[0])
        for part in range(min(WORKERS, len(self.robots))):
            mine = range(part + 1, len(self.robots) + 1, WORKERS)
            hosts = [name for number in mine for name in (scale_site.body(number), scale_site.brain(number))]
            phase = {
                host: (number - 1) / len(self.robots) + shift / (2 * len(self.robots))
                for number in mine
                for shift, host in enumerate((scale_site.body(number), scale_site.brain(number)))
            }
            given = {"as": "hosts", "hosts": hosts, "phase": phase, "direct": self.direct, "real": real}
            self.workers.append(self._worker(given))
        for name in (OPERATOR, VIEWER):
            self.persons[name] = self._worker({"as": "person", "person": name})
        for worker in (*self.workers, *self.persons.values()):
            worker.answer()
        return up_s

    def start_hub(self) -> float:
        begun_s = time.monotonic()
        self.hub = self._gateway(HUB, self._folder / "hub")
        while not self._listens():
            if time.monotonic() - begun_s > PATIENCE_S or not self.hub.is_running():
                raise ConfigError(f"the hub does not come up: {self.log(HUB)[-500:]}")
            time.sleep(0.01)
        return time.monotonic() - begun_s

    def stop_hub(self) -> None:
        assert self.hub is not None
        self.hub.terminate()
        self.hub.wait(PATIENCE_S)

    def log(self, host: str) -> str:
        return (self._folder / f"{host}.log").read_text(errors="replace")

    def _listens(self) -> bool:
        assert self.hub is not None
        wanted = f":{self._port:04X} 00000000:0000 0A"
        return wanted in Path("/proc/net/tcp").read_text()

    def _worker(self, given: dict[str, Any]) -> Worker:
        where = {"site": str(self.site.folder), "run": str(self._folder / "run")}
        return Worker({**where, **given}, self._folder / "workers.log")

    def _gateway(self, host: str, root: Path) -> psutil.Process:
        """Starts the gateway's process of a host alone."""
        name = gateway_of(host).name
        share = self.site.share_profile(host)
        run_dir = RunDir(share.robot, root)
        run_dir.make()
        run_dir.remember(msgspec.json.encode(msgspec.structs.replace(share, processes=(name,))))
        with (self._folder / f"{host}.log").open("ab") as log:
            started = subprocess.Popen(
                [sys.executable, "-m", "deploy.launch", name, "--run-dir", str(run_dir.path)],
                stderr=log,
                env={**os.environ, RUN_DIR: str(root)},
                start_new_session=True,
            )
        return psutil.Process(started.pid)

    def end(self) -> None:
        for worker in (*self.workers, *self.persons.values()):
            worker.end()
        for process in (self.hub, self.gateway):
            if process is not None and process.is_running():
                process.terminate()
                with contextlib.suppress(psutil.TimeoutExpired):
                    process.wait(5.0)
                if process.is_running():
                    process.kill()

    # --- what is measured -------------------------------------------------------------------------

    def speak(self, seconds: int) -> int:
        """Lets all hosts speak from the same time on, which it returns."""
        begin_ns = steady_ns() + AHEAD_NS
        for worker in self.workers:
            worker.order("speak", begin_ns=begin_ns, seconds=seconds)
        return begin_ns

    def spoken(self) -> list[dict[str, Any]]:
        return [worker.answer() for worker in self.workers]

    def link(self) -> None:
        """Speaks until the operator has heard every robot. Raises ConfigError when he does not."""
        operator = self.persons[OPERATOR]
        deadline_s = time.monotonic() + LINKED_S
        while True:
            operator.ask("forget")
            self.speak(WARM_S)
            self.spoken()
            missing = {*self.robots} - {*operator.ask("first")["first"]}
            if not missing:
                return
            if time.monotonic() > deadline_s:
                raise ConfigError(f"{len(missing)} robots of {len(self.robots)} are not heard at the hub")

    def measure(self, seconds: int) -> dict[str, Any]:
        """One measurement under load."""
        assert self.hub is not None
        time.sleep(DRAIN_S)
        for worker in (*self.workers, *self.persons.values()):
            worker.ask("heard")
        begin_ns = self.speak(seconds)
        time.sleep(max(0.0, (begin_ns - steady_ns()) / NS))
        psutil.cpu_percent()
        before = [cpu_s(process) for process in (self.hub, self.gateway)]
        begun_s = time.monotonic()
        operator = self.persons[OPERATOR]
        stops = [operator.ask("stop", robots=[self.robots[turn % len(self.robots)]]) for turn in range(STOPS)]
        fleet = [operator.ask("stop", robots=self.robots) for _ in range(FLEET_STOPS)]
        time.sleep(max(0.0, begin_ns / NS + seconds - 0.2 - steady_ns() / NS))
        took_s = time.monotonic() - begun_s
        after = [cpu_s(process) for process in (self.hub, self.gateway)]
        busy = psutil.cpu_percent() / 100.0
        memory = [memory_mb(process) for process in (self.hub, self.gateway)]
        spoken = self.spoken()
        time.sleep(DRAIN_S)
        used = [(end - start) / took_s for start, end in zip(before, after, strict=True)]
        return {
            "spoken": spoken, "stops": stops, "fleet": fleet, "used": used, "memory": memory, "busy": busy,
            "hosts": [worker.ask("heard") for worker in self.workers],
            "persons": {name: worker.ask("heard")["heard"] for name, worker in self.persons.items()},
            "seconds": seconds,
        }  # fmt: skip

    def restart(self) -> float | None:
        """Ends the hub's process and starts it anew while all speak; the seconds until all robots are heard again, None
        when not all are."""
        operator = self.persons[OPERATOR]
        begin_ns = self.speak(RESTART_S)
        time.sleep(max(0.0, (begin_ns - steady_ns()) / NS) + 1.0)
        self.stop_hub()
        ended_ns = steady_ns()
        operator.ask("forget")
        self.start_hub()
        first: dict[str, int] = {}
        while len(first) < len(self.robots) and steady_ns() < begin_ns + (RESTART_S - 1) * NS:
            time.sleep(0.05)
            first = operator.ask("first")["first"]
        self.spoken()
        return (max(first.values()) - ended_ns) / NS if len(first) == len(self.robots) else None


def cpu_s(process: psutil.Process | None) -> float:
    if process is None:
        return 0.0
    times = process.cpu_times()
    return float(times.user + times.system)


def memory_mb(process: psutil.Process | None) -> float:
    return 0.0 if process is None else float(process.memory_full_info().uss) / 1e6


@contextlib.contextmanager
def fleet(folder: Path, site: Site, robots: int, *, direct: bool) -> Iterator[tuple[Fleet, float]]:
    made = Fleet(folder, site, robots, direct=direct)
    try:
        yield made, made.start()
    finally:
        made.end()


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
    counts = chosen.robots or ([1, 5] if chosen.short else [1, 5, 10, 25, 50])
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
        return Chart(name, title, "robots", unit, lines)

    def one(value: float) -> tuple[float, float, float]:
        return value, value, value

    def spread(values: Sequence[float]) -> tuple[float, float, float]:
        return mid(values), min(values), percentile(values, 99)

    return [
        chart("hub", "The hub's processor time", "% of a core", hub=lambda row: one(100 * row.hub_cpu)),
        chart("memory", "The hub's own memory", "MB", hub=lambda row: one(row.hub_mb)),
        chart("rate", "Messages that leave the hub", "1/s", out=lambda row: one(row.out_hz)),
        chart(
            "command", "A command by way of the hub, median to 99th", "ms", command=lambda row: spread(row.command_ms)
        ),
        chart("stop", "Emergency stop until the last answer", "ms", of_all=lambda row: spread(row.fleet_stop_ms)),
    ]
