"""The lines that the robot's processes of this machine log, as they come."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from cocoro import private
from cocoro.errors import ConfigError

FIRST_BYTES = 16 * 1024
"""Of each file, what is read at first: its end."""
AT_ONCE_BYTES = 256 * 1024
"""What is read of one file at a time; of a file that grows faster the newest."""
FIRST_LINES = 200
_HEAD = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}) +(\w+) +([\w-]+): (.*)")


class _Read(NamedTuple):
    """How far a file was read."""

    inode: int
    at: int
    part: bytes
    """The beginning of a line whose end is not there yet."""


class LogLines:
    """Reads the files of a folder as they grow, and those that replace them."""

    def __init__(self, folder: Path, variable: str = private.RUN_DIR) -> None:
        self._folder = folder
        self._variable = variable
        self._read: dict[str, _Read] = {}
        self._begun = False

    def take(self) -> list[dict[str, Any]]:
        """The lines that are new, in the order of their times; at first the last `FIRST_LINES`. A folder or a file that
        cannot be read gives none."""
        found: list[dict[str, Any]] = []
        try:
            names = sorted(path.name for path in self._folder.iterdir() if path.name.endswith(".log"))
        except OSError:
            names = []
        for name in names:
            found += self._of(name)
        found.sort(key=lambda line: int(line["t_ns"]))
        first, self._begun = not self._begun, True
        return found[-FIRST_LINES:] if first else found

    def _of(self, name: str) -> Iterator[dict[str, Any]]:
        try:
            fd = private.open_file(self._folder / name, os.O_RDONLY, variable=self._variable)
        except (OSError, ConfigError):
            return
        try:
            status = os.fstat(fd)
            before = self._read.get(name)
            if before is None or before.inode != status.st_ino or before.at > status.st_size:
                start = 0 if self._begun else max(status.st_size - FIRST_BYTES, 0)
                before = _Read(status.st_ino, start, b"")
            at = max(before.at, status.st_size - AT_ONCE_BYTES)
            text = (before.part if at == before.at else b"") + os.pread(fd, status.st_size - at, at)
        except OSError:
            return
        finally:
            os.close(fd)
        whole, _, part = text.rpartition(b"\n")
        self._read[name] = _Read(status.st_ino, status.st_size, part[-AT_ONCE_BYTES:])
        yield from _lines(whole.decode(errors="replace"), name.removesuffix(".log"))


def _lines(text: str, service: str) -> Iterator[dict[str, Any]]:
    """The lines of one file; one without a time, as of a traceback, has that of the line before it."""
    t_ns, level = 0, "info"
    for line in text.splitlines():
        match = _HEAD.match(line)
        if match is not None:
            t_ns, level = round(datetime.fromisoformat(match[1]).timestamp() * 1e3) * 1_000_000, match[2].lower()
        if line:
            yield {"t_ns": t_ns, "level": level, "service": service, "text": match[4] if match else line}
