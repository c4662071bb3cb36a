"""What intruders cost a robot on a site: the period of base/command at the robot's host, while they flood and without.

Each kind of flood takes turns with as long a time without it. The robot stands; its planner, on another host, commands
at 50 Hz. Then: processor time of the gateway for what it refuses, how long a revocation takes, and how long newcomers
wait after handshakes that failed. Needs root, for network namespaces.
"""

from __future__ import annotations

import argparse
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from itertools import pairwise
from pathlib import Path

import msgspec
import psutil

from bench.intruder import RANDOM, Intruder
from bench.report import Report, percentile
from bench.site_lab import BRAIN, PORT, ROBOT, Lab, lab
from bench.site_witness import Witness, until
from bench.trials import number_of, sized
from cocoro.bus.base import Received
from cocoro.errors import ConfigError
from cocoro.installed import all_topics
from cocoro.messages import BaseCommand
from cocoro.topics import BASE_COMMAND, DETECTIONS, ESTOP, REPORT
from deploy.rundir import RunDir
from deploy.site import authority, place
from sim.network.network import obstacle

MARK = "intruder-"
COMMAND = BASE_COMMAND.key(ROBOT)
SMALL_BYTES, SMALL_HZ = 50, 10_000.0
HUGE_BYTES = 100_000_000
FAILED = 50
"""Handshakes that fail, one after the other."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="turns of each kind (5)")
    parser.add_argument("--seconds", type=float, help="of each turn (6)")
    parser.add_argument("--only", default="", help="the floods with this text in their name")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if why := obstacle():
        raise ConfigError(f"there can be no network of hosts here: {why}")
    count, seconds = sized(chosen, chosen.count, 5, 1), sized(chosen, chosen.seconds, 6.0, 3.0)
    with tempfile.TemporaryDirectory(prefix="site") as folder, lab(Path(folder), sensors="ideal") as site:
        site.up()
        site.deliver(site.desk, (BRAIN,))  # stolen
        with Witness(ROBOT, site.body.folder / "run", MARK.encode()) as witness:
            until(lambda: witness.count.get(COMMAND, 0) > 50)
            bench = Bench(site, witness, seconds)
            for name, who, flood in FLOODS:
                if chosen.only in name:
                    bench.compare(name, who, flood, count, report)
            if chosen.only:
                return
            bench.refusals(report)
            bench.revocation(report)
            bench.newcomers(100 if chosen.short else 1000, report)


class Bench:
    def __init__(self, site: Lab, witness: Witness, seconds: float) -> None:
        self.site = site
        self.witness = witness
        self.seconds = seconds

    def intruder(self, who: str) -> Intruder:
        credentials = self.site.site_of(self.site.desk) / place.CREDENTIALS / who
        return Intruder(self.site.desk, credentials, f"tls/{self.site.body.address}:{PORT}", yields=True)

    def period_ms(self) -> float:
        """The 99th percentile of the planner's commands, in the time of one turn."""
        arrived: list[int] = []

        def on_samples(samples: list[Received]) -> None:
            for sample in samples:
                with suppress(msgspec.MsgspecError):  # what an intruder has sent
                    msgspec.msgpack.decode(sample.payload, type=BaseCommand)
                    arrived.append(sample.received_ns)

        handle = self.witness.listen(COMMAND, on_samples)
        time.sleep(self.seconds)
        self.witness.end(handle)
        periods = [(after - before) / 1e6 for before, after in pairwise(arrived)]
        return percentile(periods, 99) if periods else self.seconds * 1e3

    def compare(self, name: str, who: str, flood: Callable[[Intruder], object], count: int, report: Report) -> None:
        calm, flooded = [], []
        for _ in range(count):
            calm.append(self.period_ms())
            with self.intruder(who) as intruder:
                over = threading.Event()
                thread = threading.Thread(target=_again, args=(flood, intruder, over))
                thread.start()
                flooded.append(self.period_ms())
                over.set()
                thread.join()
        report.value(f"99th percentile of the period without, beside: {name}", calm, "ms")
        report.ratio(f"99th percentile of the period, {name} / without", flooded, calm, better="less", at_most=1.5)

    def refusals(self, report: Report) -> None:
        gateway = psutil.Process(RunDir(ROBOT, self.site.body.folder / "run").claimant_pid("gateway-body"))

        def spent_s() -> float:
            return sum(gateway.cpu_times()[:2])

        with self.intruder("eve") as eve:
            for name, key in (("a topic's key", COMMAND), ("a key that is no topic's", f"{ROBOT}/eve/anything")):
                begun_s, before_s = time.monotonic(), spent_s()
                time.sleep(self.seconds)
                calm = (spent_s() - before_s) / (time.monotonic() - begun_s)
                begun_s, before_s = time.monotonic(), spent_s()
                count = round(self.seconds * SMALL_HZ)
                eve("flood", keys=[key], bytes=SMALL_BYTES, count=count, hz=SMALL_HZ)
                more_s = spent_s() - before_s - calm * (time.monotonic() - begun_s)
                report.value(f"processor time for a refused message on {name}", [1e6 * more_s / count], "us")
        report.value("a core for the robot's own messages", [100 * calm], "%")

    def revocation(self, report: Report) -> None:
        def log() -> str:
            return self.site.log(self.site.body, "gateway-body")

        since = len(log())
        with self.intruder("eve") as eve:
            authority.revoke(self.site.plan, "eve")
            begun_s = time.monotonic()
            self.site.deliver(self.site.body, ())
            until(lambda: "opened anew" in log()[since:])
            while eve("ask", key=REPORT.key(ROBOT), payload="who answers?"):
                pass
            report.value("from a revocation's arrival to its effect", [time.monotonic() - begun_s], "s")
            until(lambda: "linked with brain.1" in log()[since:])
            before = self.witness.count[COMMAND]
            until(lambda: self.witness.count[COMMAND] > before)
            report.value("from a revocation's arrival to the planner's next command", [time.monotonic() - begun_s], "s")

    def newcomers(self, half_open: int, report: Report) -> None:
        def wait_s() -> float:
            begun_s = time.monotonic()
            with self.intruder("ada") as ada:
                waited_s = time.monotonic() - begun_s
                assert ada.refused or ada("ask", key=REPORT.key(ROBOT), payload="who answers?")
            return waited_s

        target = (self.site.body.address, PORT)
        report.value("a newcomer's start", [wait_s()], "s")
        with ExitStack() as stack:
            for held in self.site.desk.call(lambda: [socket.create_connection(target) for _ in range(half_open)]):
                stack.enter_context(closing(held))
            report.value(f"a newcomer's start, {half_open} connections half open", [wait_s()], "s")
            time.sleep(half_open * 0.1 + 12.0)  # each is given up after 10 s, and then counts as a failed handshake
        for held in self.site.desk.call(lambda: [socket.create_connection(target) for _ in range(FAILED)]):
            with closing(held):
                held.sendall(b"no handshake" * 50)
        report.value(f"a newcomer's start after {FAILED} failed handshakes", [wait_s()], "s")


def _again(flood: Callable[[Intruder], object], intruder: Intruder, over: threading.Event) -> None:
    while not over.is_set():
        flood(intruder)


def _small(*keys: str) -> Callable[[Intruder], object]:
    return lambda intruder: intruder(
        "flood", keys=keys, bytes=SMALL_BYTES, count=round(SMALL_HZ), hz=SMALL_HZ, payload=MARK
    )


def _huge(key: str) -> Callable[[Intruder], object]:
    return lambda intruder: intruder("flood", keys=[key], bytes=HUGE_BYTES, count=1, payload=MARK)


def _asking(key: str) -> Callable[[Intruder], object]:
    return lambda intruder: intruder("asks", key=key, payload=MARK, count=2000)


_TOPICS = [topic.key(ROBOT) for topic in all_topics() if not topic.per_service]
FLOODS: tuple[tuple[str, str, Callable[[Intruder], object]], ...] = (
    ("nothing", "eve", lambda intruder: time.sleep(0.1)),
    ("small ones of a viewer on each topic", "eve", _small(*_TOPICS)),
    ("small ones of a viewer on a key that is no topic's", "eve", _small(f"{ROBOT}/eve/anything")),
    ("a viewer's questions", "eve", _asking(REPORT.key(ROBOT))),
    ("a viewer's stops, malformed", "eve", _asking(ESTOP.of("base").key(ROBOT))),
    ("an operator's questions", "ada", _asking(REPORT.key(ROBOT))),
    ("small ones of an author on his own key", "bob", _small(f"{ROBOT}/bob/anything")),
    ("100 MB of an author on his own key", "bob", _huge(f"{ROBOT}/bob/anything")),
    ("100 MB of a viewer", "eve", _huge(COMMAND)),
    ("small ones of a second brain on its keys", BRAIN, _small(COMMAND, DETECTIONS.key(ROBOT))),
    (
        "random bytes of a second brain on its keys",
        BRAIN,
        lambda intruder: [intruder("put", key=key, payload=RANDOM) for key in (COMMAND, DETECTIONS.key(ROBOT))],
    ),
)
