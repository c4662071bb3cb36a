"""Fetches back to back over three hosts for a long time: `python -m bench site-soak --minutes 60`.

Memory and open files of every process on the robot's host and on the brain's are looked at every few seconds. After the
first minutes the own memory of none may grow by more than a twentieth; when all is down nothing may be left in shared
memory. Frames in shared memory are counted apart: their pool has a fixed size, of which a process has as much resident
as it has touched so far.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

from bench.report import Report
from bench.site_lab import ROBOT, Lab, lab
from bench.trials import Runs
from cocoro.errors import ConfigError
from deploy.rundir import RunDir
from sim.network.network import Host, obstacle

LOOK_S = 5.0
SETTLED_SHARE = 1 / 12
"""The first part of the run, in which memory may grow: 5 minutes of an hour."""
GROWTH = 1.05
_RESIDENT = re.compile(r"^Rss(Anon|File|Shmem):\s+(\d+) kB$", re.MULTILINE)


class Look(NamedTuple):
    """One process at one time."""

    at_s: float
    own_mb: float
    """Resident, without shared memory."""
    shared_mb: float
    files: int


class Watch:
    """Looks at the processes of hosts in a thread of its own."""

    def __init__(self, *hosts: Host) -> None:
        self._dirs = [RunDir(ROBOT, host.folder / "run") for host in hosts]
        self.looks: dict[str, list[Look]] = defaultdict(list)
        self._begun_s = time.monotonic()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._end.wait(LOOK_S):
            for run_dir in self._dirs:
                for by in {by.pid: by for by in run_dir.claims().values()}.values():
                    self._look(f"{by.name} {by.pid}", by.pid)

    def _look(self, name: str, pid: int) -> None:
        try:
            status = Path(f"/proc/{pid}/status").read_text()
            files = len(os.listdir(f"/proc/{pid}/fd"))  # noqa: PTH208 # only their number
        except OSError:
            return
        resident = {kind: int(kib) * 1024 / 1e6 for kind, kib in _RESIDENT.findall(status)}
        if resident:  # else it has just ended
            own_mb = resident["Anon"] + resident["File"]
            self.looks[name].append(Look(time.monotonic() - self._begun_s, own_mb, resident["Shmem"], files))


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--minutes", type=float, help="of fetches (60)")


def fetches(site: Lab, until_s: float, runs: Runs) -> None:
    """Fetches the red can and puts it down again, in turns."""
    number = 0
    while time.monotonic() < until_s:
        number += 1
        code, said, _ = site.command(site.desk, "fetch", "red_can", *site.as_person("ada"))
        down, said_down, _ = site.command(site.desk, "put-down", *site.as_person("ada"))
        lines = said.partition("\nrecorded in ")[0].strip().splitlines() or ["it said nothing"]
        runs.add(code == 0 and down == 0, f"{number}: {lines[-1]}", [said, said_down])


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if why := obstacle():
        raise ConfigError(f"there can be no network of hosts here: {why}")
    minutes = chosen.minutes if chosen.minutes is not None else 1.0 if chosen.short else 60.0
    runs = Runs(report)
    with tempfile.TemporaryDirectory(prefix="site") as name, lab(Path(name), sensors="real") as site:
        site.network.links().set(delay_ms=1.0)
        site.up()
        watch = Watch(site.body, site.brain)
        fetches(site, time.monotonic() + 60 * minutes, runs)
        watch.close()
        site.down()
        left = [entry for host in (site.body, site.brain) for entry in host.call(os.listdir, "/dev/shm")]
    settled_s = 60 * minutes * SETTLED_SHARE
    grown: dict[str, float] = {}
    for process, looks in sorted(watch.looks.items()):
        after = [look for look in looks if look.at_s >= settled_s]
        if len(after) < 4:
            continue
        part = max(1, len(after) // 4)
        first, last = after[:part], after[-part:]
        grown[process] = max(look.own_mb for look in last) / max(look.own_mb for look in first)
        files = max(look.files for look in last) - max(look.files for look in first)
        course = ", ".join(f"{looks[at * (len(looks) - 1) // 8].own_mb:.0f}" for at in range(9))
        shared = f"{first[0].shared_mb:.0f} to {last[-1].shared_mb:.0f} MB of shared memory"
        report.say(f"{process}: {course} MB, x {grown[process]:.3f}; {shared}; {last[-1].files} files, {files:+d}")
        report.value(f"open files more at the end, {process.split()[0]}", [files], "", at_most=2)
    worst = "own memory at the end / after the first twelfth, the worst process"
    report.value(worst, [max(grown.values())], "x", at_most=GROWTH)
    report.value("left in shared memory", [len(left)], "", at_most=0)
    runs.share("fetched and put down")
