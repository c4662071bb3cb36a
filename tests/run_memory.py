"""Watches the memory of all processes of a run of the tests: `python tests/run_memory.py FOLDER`, until SIGTERM.

They are those whose environment names the folder (`COCORO_TESTS_RECORD`). Memory that several processes share is
counted in parts (proportional set size, proc_pid_smaps(5)), so that the sum has each page once. `memory.json` in the
folder gets the largest processes of the look with the largest sum, of every look the sum, its parts by the file of
tests for which a process runs and the processor time that nobody has used until then, and for every test the most that
was there while it ran: what its worker does not share with other workers, and all processes that tests of this worker
have started, also earlier ones of its file, whose fixtures go on. A worker writes which test it runs (`running-PID`,
`tests/run_record.py`), and what a test starts inherits the variables `PYTEST_CURRENT_TEST` and `COCORO_TESTS_WORKER`,
the number of the worker. What begins and ends between two looks is not seen.
"""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import sys
import time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

LOOK_S = 0.5
AGAIN = 10
"""So many looks later at the latest a process is measured again, and asked again whether it has the mark, which it
may have got by exec."""
CHANGED_MB = 1.0
"""A process whose resident memory has changed by this is measured at once. Otherwise not at each look, since the kernel
walks all its pages for that, which takes milliseconds."""
LEAST_MB = 40.0
"""A worker alone: what it has written to of the memory that it shared at first. No test counts as needing less."""
SHOWN = 12
"""Largest processes that are named."""
LAST = "last"
"""Beside the folder of a run: that of the run before."""
MEMORY = "memory.json"
KEPT = 0.9
"""Share of what a test needed in the run before that counts at least: a look may miss the moment that needs most."""
RUNNING = "running-"
"""Before the number of a worker: the file that has the test that it runs."""
WORKER = "COCORO_TESTS_WORKER"
"""Environment variable of what tests start: the number of the worker that runs them."""
_PAGE = resource.getpagesize()
_TICKS_HZ = os.sysconf("SC_CLK_TCK")
_FIELD = re.compile(rb"^(Pss|Private_Clean|Private_Dirty):\s+(\d+) kB", re.MULTILINE)
_TEST = re.compile(rb"(?:^|\0)PYTEST_CURRENT_TEST=([^\0]+) \(\w+\)")
_WORKER = re.compile(rb"(?:^|\0)" + WORKER.encode() + rb"=(\d+)")


class Memory(NamedTuple):
    """The memory of a process, MB."""

    part: float
    """What it shares is counted in parts."""
    own: float
    """What it does not share."""


class Origin(NamedTuple):
    """Where a process comes from."""

    test: str
    """The test that started it, or nothing: then it runs tests itself."""
    worker: str
    """The number of the worker of that test."""


class Measured(NamedTuple):
    """A process when it was measured last."""

    title: str
    memory: Memory
    resident_mb: float
    look: int
    sharers: int
    """How many processes ran tests: they share memory with one another."""


class Seen(NamedTuple):
    """A process at one look."""

    title: str
    memory: Memory
    test: str
    """For which it runs: that which started it, or the one that it runs."""
    need_of: str
    """The test that runs now and needs it."""
    worker: bool
    """It runs tests itself, and shares with the other workers what none of them needs more for."""


class Watch:
    """The processes whose environment has a mark."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._mark = f"COCORO_TESTS_RECORD={folder}".encode()
        self._ours: dict[tuple[str, bytes], Origin] = {}
        """By number and time of birth."""
        self._strangers: set[tuple[str, bytes]] = set()
        """Those without the mark."""
        self._measured: dict[tuple[str, bytes], Measured] = {}
        self.peak_mb, self.at_s = 0.0, 0.0
        self.looks: list[tuple[float, float, dict[str, float]]] = []
        """Time in s, sum in MB, and its parts by the file of tests."""
        self.idle_s: list[float] = []
        """For each look the processor time that nobody has used since the begin, s, of all cores."""
        self.largest: list[tuple[str, float, str]] = []
        self.own_mb: dict[str, float] = defaultdict(float)
        """By test."""
        if (before := folder.parent / LAST / MEMORY).is_file():
            needed_mb = json.loads(before.read_text()).get("own_mb", {})
            self.own_mb |= {test: round(KEPT * mb, 1) for test, mb in needed_mb.items() if KEPT * mb > LEAST_MB}
        self._begun_s, self._idle_before_s = time.monotonic(), _idle_s()

    def look(self) -> None:
        """Sum the memory of all that run now."""
        self._find()
        found: list[Seen] = []
        sharers = sum(not origin.test for origin in self._ours.values())
        for (name, born), origin in self._ours.items():
            with suppress(OSError, IndexError):
                runs = self._runs(origin.worker if origin.test else name)
                test = origin.test or runs
                now = self._measure((name, born), 0 if origin.test else sharers)
                found.append(Seen(now.title, now.memory, test, runs or test, worker=not origin.test))
        total_mb, at_s = sum(seen.memory.part for seen in found), time.monotonic() - self._begun_s
        parts: dict[str, float] = defaultdict(float)
        own_mb: dict[str, float] = defaultdict(float)
        for seen in found:
            parts[seen.test.partition("::")[0] or seen.title] += round(seen.memory.part, 1)
            own_mb[seen.need_of] += seen.memory.own if seen.worker else seen.memory.part
        for test, size_mb in own_mb.items():
            self.own_mb[test] = max(self.own_mb[test], round(size_mb, 1))
        self.looks.append((round(at_s, 1), round(total_mb, 1), parts))
        self.idle_s.append(round(_idle_s() - self._idle_before_s, 2))
        if total_mb > self.peak_mb:
            self.peak_mb, self.at_s = total_mb, at_s
            largest = sorted(found, key=lambda one: -one.memory.part)[:SHOWN]
            self.largest = [(seen.title, round(seen.memory.part, 1), seen.test) for seen in largest]

    def _find(self) -> None:
        """Find the processes with the mark."""
        if len(self.looks) % AGAIN == 0:
            self._strangers = set()
        ours: dict[tuple[str, bytes], Origin] = {}
        strangers: set[tuple[str, bytes]] = set()
        for name in os.listdir("/proc"):  # noqa: PTH208 # many times a minute
            if not name.isdigit() or int(name) == os.getpid():
                continue
            with suppress(OSError, IndexError):
                born = _read(name, "stat").rpartition(b")")[2].split()[19]
                origin = self._ours.get((name, born))
                if (name, born) in self._strangers:
                    strangers.add((name, born))
                    continue
                if origin is None or not origin.test:
                    environment = _read(name, "environ")
                    if self._mark not in environment and origin is None:
                        strangers.add((name, born))
                        continue
                    origin = _origin(environment)
                ours[name, born] = origin
        self._ours, self._strangers = ours, strangers
        self._measured = {key: measured for key, measured in self._measured.items() if key in ours}

    def _measure(self, key: tuple[str, bytes], sharers: int) -> Measured:
        """Measure a process, unless it has hardly changed since it was measured last."""
        name, look = key[0], len(self.looks)
        resident_mb = int(_read(name, "statm").split()[1]) * _PAGE / 1e6
        last = self._measured.get(key)
        if (
            last is None
            or look - last.look >= AGAIN
            or last.sharers != sharers
            or abs(resident_mb - last.resident_mb) >= CHANGED_MB
        ):
            process = Path("/proc") / name
            last = self._measured[key] = Measured(_title(name), memory_mb(process), resident_mb, look, sharers)
        return last

    def _runs(self, number: str) -> str:
        try:
            return (self._folder / f"{RUNNING}{number}").read_text()
        except OSError:
            return ""


def memory_mb(process: Path) -> Memory:
    """The memory of the process with this folder in /proc."""
    try:
        found = dict(_FIELD.findall(process.joinpath("smaps_rollup").read_bytes()))
        sizes = {name: int(size) * 1024 / 1e6 for name, size in found.items()}
        own_mb = sizes.get(b"Private_Clean", 0.0) + sizes.get(b"Private_Dirty", 0.0)
        return Memory(sizes.get(b"Pss", 0.0), own_mb)
    except PermissionError:  # a process of another user: what is shared is counted whole
        whole_mb = int(process.joinpath("statm").read_text().split()[1]) * _PAGE / 1e6
        return Memory(whole_mb, whole_mb)


def _origin(environment: bytes) -> Origin:
    test, worker = _TEST.search(environment), _WORKER.search(environment)
    return Origin(test[1].decode() if test else "", worker[1].decode() if worker else "")


def _read(process: str, file: str) -> bytes:
    """A file of the process in /proc."""
    with open(f"/proc/{process}/{file}", "rb", buffering=0) as opened:  # noqa: PTH123 # thousands of times a minute
        return opened.readall()


def _idle_s() -> float:
    """Processor time that nobody has used since the system's start, s, of all cores; with the waits for disks."""
    idle, waits = Path("/proc/stat").read_bytes().split(maxsplit=6)[4:6]
    return (int(idle) + int(waits)) / _TICKS_HZ


def _title(process: str) -> str:
    words = _read(process, "cmdline").decode(errors="replace").split("\0")
    return " ".join(Path(word).name if "/" in word else word for word in words)[:60].strip()


def main() -> None:
    folder = Path(sys.argv[1])
    watch = Watch(folder)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    try:
        while True:
            watch.look()
            time.sleep(LOOK_S)
    finally:
        names = ("peak_mb", "at_s", "largest", "looks", "idle_s", "own_mb")
        folder.joinpath(MEMORY).write_text(json.dumps({name: getattr(watch, name) for name in names}))


if __name__ == "__main__":
    main()
