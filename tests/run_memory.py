"""Watches the memory of all processes of a run of the tests: `python tests/run_memory.py FOLDER`, until SIGTERM.

They are those whose environment names the folder (`COCORO_TESTS_RECORD`). Memory that several processes share is
counted in parts (proportional set size, proc_pid_smaps(5)). The largest sum of all looks is written to `memory.json`
in the folder. What begins and ends between two looks is not seen.
"""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

LOOK_S = 0.5
SHOWN = 12
"""Largest processes that are named."""
_PSS = re.compile(rb"^Pss:\s+(\d+) kB", re.MULTILINE)


class Watch:
    """The processes whose environment has a mark."""

    def __init__(self, mark: str) -> None:
        self._mark = mark.encode()
        self._ours: dict[tuple[int, str], bool] = {}
        self.peak_mb, self.at_s, self.looks = 0.0, 0.0, 0
        self.largest: list[tuple[str, float]] = []
        self._begun_s = time.monotonic()

    def look(self) -> None:
        """Sum the memory of all that run now."""
        now: dict[tuple[int, str], bool] = {}
        found: list[tuple[str, float]] = []
        for name in os.listdir("/proc"):  # noqa: PTH208 # many times a minute
            if not name.isdigit() or int(name) == os.getpid():
                continue
            with suppress(OSError, IndexError):
                process = Path("/proc") / name
                born = process.joinpath("stat").read_text(errors="replace").rpartition(")")[2].split()[19]
                known = (int(name), born)
                now[known] = self._ours.get(known) or self._mark in process.joinpath("environ").read_bytes()
                if now[known]:
                    found.append((_title(process), _memory_mb(process)))
        self._ours = now
        self.looks += 1
        total_mb = sum(size for _, size in found)
        if total_mb > self.peak_mb:
            self.peak_mb, self.at_s = total_mb, time.monotonic() - self._begun_s
            self.largest = sorted(found, key=lambda one: -one[1])[:SHOWN]


def _memory_mb(process: Path) -> float:
    try:
        match = _PSS.search(process.joinpath("smaps_rollup").read_bytes())
        return int(match[1]) * 1024 / 1e6 if match else 0.0
    except PermissionError:  # a process of another user: what is shared is counted whole
        return int(process.joinpath("statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def _title(process: Path) -> str:
    words = process.joinpath("cmdline").read_bytes().decode(errors="replace").split("\0")
    return " ".join(Path(word).name if "/" in word else word for word in words)[:60].strip()


def main() -> None:
    folder = Path(sys.argv[1])
    watch = Watch(f"COCORO_TESTS_RECORD={folder}")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    try:
        while True:
            watch.look()
            time.sleep(LOOK_S)
    finally:
        written = {"peak_mb": watch.peak_mb, "at_s": watch.at_s, "looks": watch.looks, "largest": watch.largest}
        folder.joinpath("memory.json").write_text(json.dumps(written))


if __name__ == "__main__":
    main()
