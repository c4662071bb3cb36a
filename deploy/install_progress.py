"""Shows the progress of an installation by pip, and what takes the space afterwards.

    pip install ... 2>&1 | python deploy/install_progress.py    # one line rewritten on a terminal, else lines
    .venv/bin/python deploy/install_progress.py sizes           # the installed packages by their size on disk

It runs before anything is installed, so it uses the standard library alone.
"""

from __future__ import annotations

import os
import re
import select
import shutil
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib import metadata
from pathlib import Path

SHOWN = 10
"""Packages in the list of sizes; the others are summed up."""
FETCHED = re.compile(
    r"\s*(?:Downloading|Using cached|Processing) (?:\S*/)?([A-Za-z0-9._]+)-\S+\.(?:whl|gz)\S* ?(\(.*\))?"
)
UNPACKING = re.compile(r"Installing collected packages: (.*)")
WRONG = re.compile(r"\s*(ERROR|error):")
WHY = {
    "pybullet": "the physics and the data that come with it",
    "scipy": "search of postures, routes and fits",
    "opencv-python-headless": "pictures",
    "numpy": "arrays",
    "foxglove-sdk": "tests of exports",
    "mypy": "checks of types",
    "matplotlib": "plots of the experiments",
    "fonttools": "plots of the experiments",
    "eclipse-zenoh": "the mesh",
    "zstandard": "captures",
    "pillow": "plots of the experiments",
    "hypothesis": "tests",
    "ruff": "style",
    "pip": "the installer",
    "setuptools": "the installer",
}


class Progress:
    """Says what pip does: `show` replaces the last line on a terminal."""

    def __init__(self) -> None:
        self._begun_s = time.monotonic()
        self._terminal = sys.stdout.isatty()
        self._text = ""

    def show(self, text: str) -> None:
        self._text = text
        if self._terminal:
            self.tick()
        else:
            print(f"  {text}", flush=True)

    def tick(self) -> None:
        """Renews the time on a terminal."""
        if self._terminal and self._text:
            columns = shutil.get_terminal_size().columns
            line = f"  {time.monotonic() - self._begun_s:4.0f} s  {self._text}"
            sys.stdout.write(f"\r\x1b[K{line[: columns - 1]}")
            sys.stdout.flush()

    def say(self, text: str) -> None:
        if self._terminal:
            sys.stdout.write("\r\x1b[K")
        print(text, flush=True)

    def close(self) -> None:
        if self._terminal:
            sys.stdout.write("\r\x1b[K")
            sys.stdout.flush()


def follow(output: Iterable[str], progress: Progress) -> None:
    """Shows the progress that pip's lines tell, and their errors."""
    fetched = 0
    for line in output:
        if found := FETCHED.match(line):
            fetched += 1
            progress.show(f"package {fetched}: {found[1]} {found[2] or ''}".rstrip())
        elif found := UNPACKING.match(line):
            progress.show(f"unpacking {len(found[1].split(','))} packages")
        elif WRONG.match(line):
            progress.say(line.rstrip())
    progress.close()


def lines(progress: Progress) -> Iterator[str]:
    """The lines of standard input; between them the progress is renewed each second."""
    rest = b""
    while True:
        if not select.select([0], [], [], 1.0)[0]:
            progress.tick()
            continue
        data = os.read(0, 65536)
        if not data:
            break
        *whole, rest = (rest + data).split(b"\n")
        yield from (line.decode(errors="replace") for line in whole)
    if rest:
        yield rest.decode(errors="replace")


def sizes() -> dict[str, int]:
    """Bytes on disk of each installed distribution, largest first."""
    found: dict[str, int] = defaultdict(int)
    for distribution in metadata.distributions():
        name = distribution.metadata["Name"].lower()
        for file in distribution.files or ():
            with suppress(OSError):
                found[name] += Path(str(distribution.locate_file(file))).stat().st_size
    return dict(sorted(found.items(), key=lambda each: -each[1]))


def print_sizes() -> None:
    found = sizes()
    print(f"{sum(found.values()) / 1e6:.0f} MB in {len(found)} packages:")
    for name in list(found)[:SHOWN]:
        print(f"  {found.pop(name) / 1e6:4.0f} MB  {name:<24}{WHY.get(name, '')}".rstrip())
    print(f"  {sum(found.values()) / 1e6:4.0f} MB  the other {len(found)}")


if __name__ == "__main__":
    if sys.argv[1:] == ["sizes"]:
        print_sizes()
    else:
        shown = Progress()
        follow(lines(shown), shown)
