"""The cockpit over a slow link that loses packets: how old pictures are at the viewer, how coarse, and STOP from there.

The simulated robot with all its services is on one host, the viewer on another, with an emulated network between them
(`sim.network`; needs root) and TLS, as from any other machine. The link is good at first, and then as slow as asked
for, so what is in the queues at the change counts, too. A page on the robot's host turns the robot; the viewer, who
looks at pictures all the time, stops it by its socket, again every 0.4 s until that is acknowledged, as the page does.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import ssl
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from bench.cockpit_clock import StampClock
from bench.cockpit_stop import PATIENCE_S, TurningPage, by_the_truth
from bench.cockpit_viewer import header_of
from bench.report import Report, percentile
from bench.trials import Runs, number_of, sized
from cocoro.errors import CocoroError, ConfigError
from deploy.site import authority
from sim.network.network import Host, Network, obstacle

OLD_MS = 500.0
ROBOT, VIEWER = "robot", "viewer"
PERSON = "ada"
GOOD_S = 5.0
"""How long the link is good before it becomes slow."""
AGAIN_S = 0.4
PLAN = f"""
name = "lab"
[robot.calliope]
profile = "sim"
[host.{ROBOT}]
role = "robot"
robot = "calliope"
[person.{PERSON}]
role = "operator"
"""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rate-mbps", type=float, default=1.0, help="of the link, each way (1)")
    parser.add_argument("--loss", type=float, default=0.05, help="share of packets that are lost, each way (0.05)")
    parser.add_argument("--delay-ms", type=float, default=10.0, help="of the link, each way (10)")
    parser.add_argument("--seconds", type=float, help="of looking (60)")
    parser.add_argument("--count", type=number_of, help="stops (20)")
    parser.add_argument("--seed", type=int, default=0, help="of what is lost")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if why := obstacle():
        raise ConfigError(f"there can be no network of hosts here: {why}")
    seconds, count = sized(chosen, chosen.seconds, 60.0, 5.0), sized(chosen, chosen.count, 20, 2)
    slow = {"rate_bps": chosen.rate_mbps * 1e6, "loss": chosen.loss, "delay_ms": chosen.delay_ms}
    with tempfile.TemporaryDirectory(prefix="cockpit") as name, Network(ROBOT, VIEWER, seed=chosen.seed) as network:
        link = network.link(ROBOT, VIEWER)
        link.set(delay_ms=chosen.delay_ms)
        with _Robot(network.host(ROBOT), Path(name)) as robot, robot.opened(network.host(VIEWER)) as socket:
            viewer = Viewer(socket)
            time.sleep(GOOD_S)
            link.set(**slow)
            changed_ns = time.monotonic_ns()
            time.sleep(seconds)
            _report_pictures(viewer, robot, changed_ns, report)
            _stops(viewer, robot, count, report)


class Shown(NamedTuple):
    """A picture at the viewer."""

    stamp_ns: int
    arrived_ns: int
    """CLOCK_MONOTONIC."""
    level: str
    size: int


class Viewer:
    """A page that looks at pictures, in a thread, and may stop the robot."""

    def __init__(self, socket: ClientConnection) -> None:
        self.shown: list[Shown] = []
        self._socket = socket
        self._acknowledged = threading.Event()
        self._ids = 0
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        try:
            for message in self._socket:
                self._take(message)
        except ConnectionClosed:
            return

    def _take(self, message: str | bytes) -> None:
        if isinstance(message, bytes):
            header = header_of(message)
            now_ns, stamp_ns = time.monotonic_ns(), header["stamp_ns"]
            self._socket.send(json.dumps({"do": "seen", "stamp_ns": stamp_ns}))
            self.shown.append(Shown(stamp_ns, now_ns, header["level"], len(message)))
        elif json.loads(message)["kind"] == "stopped":
            self._acknowledged.set()

    def stop(self) -> tuple[int, float]:
        """Stop the robot; returns when that was sent first (CLOCK_MONOTONIC), and the time to its acknowledgement,
        ms. Raises CocoroError without one."""
        self._acknowledged.clear()
        sent_ns = time.monotonic_ns()
        for _ in range(round(PATIENCE_S / AGAIN_S)):
            self._ids += 1
            self._socket.send(json.dumps({"do": "stop", "id": self._ids}))
            if self._acknowledged.wait(AGAIN_S):
                return sent_ns, (time.monotonic_ns() - sent_ns) / 1e6
        raise CocoroError("no stop of the viewer was acknowledged")


class _Robot:
    """The robot on its host, with a cockpit that is open to others."""

    def __init__(self, host: Host, folder: Path) -> None:
        self.host = host
        self._site = folder / "site"
        self._site.mkdir(mode=0o700)
        (self._site / "site.toml").write_text(PLAN)
        now = datetime.now(UTC)
        authority.init(self._site, now)
        authority.issue(self._site, "robot", ROBOT, now, addresses=(host.address,))
        authority.issue(self._site, "operator", PERSON, now)
        self.motion = folder / "motion"
        self._port = 0

    def __enter__(self) -> _Robot:
        settings = {
            "service.sim.motion": str(self.motion),
            "service.cockpit.host": self.host.address,
            "service.cockpit.credentials": str(self._site / "credentials" / ROBOT),
            "service.cockpit.site": str(self._site),
        }
        said = self._cocoro("up", "sim", "--detach", *(f"--set={key}={json.dumps(it)}" for key, it in settings.items()))
        found = re.search(r"cockpit: https://[^ ]*:(\d+)/", said)
        if found is None:
            raise CocoroError(f"the robot with a cockpit did not start: {said}")
        self._port = int(found[1])
        return self

    def __exit__(self, *_: object) -> None:
        self._cocoro("down")

    def _cocoro(self, *arguments: str) -> str:
        argv = [sys.executable, "-m", "apps.cli.main", *arguments]
        process = self.host.run(argv, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        return str(process.communicate(timeout=120.0)[0])

    @contextmanager
    def opened(self, host: Host) -> Iterator[ClientConnection]:
        """A page's connection from a host, with the person's certificate."""
        own = self._site / "credentials" / PERSON
        context = ssl.create_default_context(cafile=str(own / "ca.pem"))
        context.load_cert_chain(own / "cert.pem", own / "key.pem")
        socket = host.socket()
        socket.connect((self.host.address, self._port))
        url = f"wss://{self.host.address}:{self._port}/live"
        with connect(url, sock=socket, ssl=context, compression=None, max_size=None) as opened:
            yield opened


def _report_pictures(viewer: Viewer, robot: _Robot, changed_ns: int, report: Report) -> None:
    clock = StampClock.of_file(robot.motion)
    shown = [picture for picture in viewer.shown if picture.arrived_ns >= changed_ns]
    if not shown:
        raise CocoroError("no picture came over the slow link")
    ages = [(picture.arrived_ns - clock.real_ns(picture.stamp_ns)) / 1e6 for picture in shown]
    before = [picture.level for picture in viewer.shown if picture.arrived_ns < changed_ns]
    seconds = (shown[-1].arrived_ns - changed_ns) / 1e9
    levels = Counter(picture.level for picture in shown).most_common()
    report.notes.append(f"size divisor/quality on the good link: {before[-1]}; on the slow one {dict(levels)}")
    report.say(report.notes[-1])
    report.value("from a picture's stamp to the viewer", ages, "ms", at_most=OLD_MS)
    report.value("the same, 95 of 100 pictures", [percentile(ages, 95.0)], "ms", at_most=OLD_MS)
    report.value("the same, the oldest picture", [max(ages)], "ms")
    report.share(f"pictures that are at most {OLD_MS:g} ms old", sum(age <= OLD_MS for age in ages), len(ages))
    report.value("pictures a second", [len(shown) / seconds], "Hz")
    report.value("a picture", [picture.size / 1e3 for picture in shown], "kB")


def _stops(viewer: Viewer, robot: _Robot, count: int, report: Report) -> None:
    """The viewer stops the robot while a page on the robot's own host turns it."""
    runs, told, sent_ns = Runs(report), list[float](), list[int]()
    with robot.opened(robot.host) as socket, ThreadPoolExecutor(1) as pool:
        page = TurningPage(socket)
        for number in range(1, count + 1):
            at_ns, ms = _stopped_turning(page, viewer, pool, random.Random(number).uniform(0.3, 0.8))
            sent_ns.append(at_ns)
            told.append(ms)
            runs.add(True, f"{number}: acknowledged to the viewer after {ms:.0f} ms")
    time.sleep(0.5)
    zero, _ = by_the_truth(robot.motion, sent_ns)
    report.value("STOP of the viewer, to zero commanded", zero, "ms")
    report.value("the latest of them", [max(zero)], "ms")
    report.value("to its acknowledgement at the viewer", told, "ms")


def _stopped_turning(page: TurningPage, viewer: Viewer, pool: Executor, turns_s: float) -> tuple[int, float]:
    """The page turns the robot until the viewer has stopped it; returns as `Viewer.stop`."""
    stopping: list[Future[tuple[int, float]]] = []

    def over(turned_s: float) -> bool:
        if turned_s >= turns_s and not stopping:
            stopping.append(pool.submit(viewer.stop))
        return bool(stopping) and stopping[0].done()

    page.begin()
    page.turn(over)
    return stopping[0].result()
