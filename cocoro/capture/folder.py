"""The folder of captures: the names of the files, which of them are pinned, and which make room for new ones."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

FOLDER = "COCORO_CAPTURE_DIR"
"""Environment variable with the captures' folder, used when the configuration names none."""
PIN = ".pin"
"""A file with this ending beside a capture pins it: the recorder never deletes it."""
NEWEST_IDLE = 2
"""Captures in which nothing happened and that stay as long as others can go: about the last hour."""
IDLE, MOTION = "idle", "motion"
_NAME = re.compile(r"(?P<run>(?P<robot>.+)-\d{8}T\d{6}Z)-(?P<number>\d{3,})(?:-(?P<label>[A-Za-z0-9_.+-]+))?\.mcap")
_UNFIT = re.compile(r"[^A-Za-z0-9_.+-]+")
LONGEST_LABEL = 60


class CaptureName(NamedTuple):
    """The parts of the name of a recorder's file."""

    robot: str
    run: str
    """The robot's name and the start of the recorder; equal for all files of one run."""
    number: int
    label: str
    """What happened in it: a task with its target (`fetch-red_can`), `stop`, `fault`, `motion`, or `idle` for nothing;
    '' where the recorder did not tell these apart."""

    @property
    def rank(self) -> int:
        """The lower, the earlier it makes room."""
        return {IDLE: 0, MOTION: 1}.get(self.label, 2)


def default_folder() -> Path:
    """The captures' folder where no configuration names one."""
    if explicit := os.environ.get(FOLDER):
        return Path(explicit)
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state") / "cocoro" / "captures"


def file_name(robot: str, started: datetime, number: int, label: str = "") -> str:
    """The name of a run's nth file. Names sort by the wall clock's time at the start of the run."""
    return f"{_run(robot, started)}-{number:03}{f'-{label}' if label else ''}.mcap"


def label_of(*words: str) -> str:
    """Words as a label in a file's name."""
    return "-".join(filter(None, (_UNFIT.sub("_", word) for word in words)))[:LONGEST_LABEL]


def parsed_name(path: Path) -> CaptureName | None:
    """None for a file that no recorder named."""
    match = _NAME.fullmatch(path.name)
    if match is None:
        return None
    return CaptureName(match["robot"], match["run"], int(match["number"]), match["label"] or "")


def captures(folder: Path, robot: str) -> list[Path]:
    """A robot's captures in a folder, oldest first."""
    found = [(name.run, name.number, path) for path in folder.glob("*.mcap") if (name := parsed_name(path))]
    return [path for _, _, path in sorted(found) if parsed_name(path).robot == robot]  # type: ignore[union-attr]


def pin_of(path: Path) -> Path:
    return path.with_name(path.name + PIN)


def is_pinned(path: Path) -> bool:
    return pin_of(path).exists()


def delete(path: Path) -> None:
    """Delete a capture and its pin. Raises OSError."""
    path.unlink()
    pin_of(path).unlink(missing_ok=True)


class KeptCaptures(NamedTuple):
    gone: list[Path]
    """Deleted now."""
    kept_bytes: int
    """Size of those that are left, without pinned ones."""


def make_room(folder: Path, robot: str, keep_bytes: int, started: datetime | None = None) -> KeptCaptures:
    """Delete captures of a robot until the others take at most `keep_bytes`.

    Captures in which nothing happened go first, except the newest two, then those in which the robot only moved, then
    the others: with a task, a stop or a fault, or of a recorder that did not tell these apart. Each kind goes oldest
    first. Pinned ones neither go nor count. The newest capture never goes, nor does the newest of the last kind.

    The current run's files, which began at `started`, count as the newest, in the order of their numbers, whatever
    the wall clock said when others were begun.
    """
    own = "" if started is None else _run(robot, started)
    files = sorted(captures(folder, robot), key=lambda path: _age(path, own))
    sizes = {path: size for path in files if not is_pinned(path) and (size := _size(path)) is not None}
    left = sum(sizes.values())
    gone = []
    for path in _in_order([path for path in files if path in sizes], files[-1:]):
        if left <= keep_bytes:
            break
        with suppress(OSError):
            delete(path)
            left -= sizes[path]
            gone.append(path)
    return KeptCaptures(gone, left)


def _in_order(files: list[Path], newest: Iterable[Path]) -> list[Path]:
    """The captures that may go, in the order in which they go. `files` are sorted by age, oldest first."""
    ranks: dict[int, list[Path]] = {0: [], 1: [], 2: []}
    for path in files:
        name = parsed_name(path)
        assert name is not None
        ranks[name.rank].append(path)
    idle = ranks[0]
    order = [*idle[:-NEWEST_IDLE], *ranks[1], *ranks[2][:-1], *idle[-NEWEST_IDLE:]]
    return [path for path in order if path not in newest]


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:  # removed meanwhile
        return None


def _run(robot: str, started: datetime) -> str:
    return f"{robot}-{started:%Y%m%dT%H%M%SZ}"


def _age(path: Path, own: str) -> tuple[bool, str, int]:
    """Sort key, oldest first."""
    name = parsed_name(path)
    assert name is not None
    return name.run == own, "" if name.run == own else name.run, name.number


class RecordingFolder:
    """Gives a recorder the paths of its files, and makes room before each."""

    def __init__(
        self, folder: Path, robot: str, started: datetime, keep_bytes: int | None, reserve_bytes: int,
        free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ) -> None:  # fmt: skip
        """`reserve_bytes`: what must be free on the disk when a file begins; captures that `keep_bytes` would keep go
        for it, too."""
        while any(folder.glob(f"{_run(robot, started)}-*.mcap")):
            started += timedelta(seconds=1)
        self.folder = folder
        self.label = ""
        """Label of the next file."""
        self.kept_bytes = 0
        """Size of this robot's captures when the newest file began, without pinned ones."""
        self.keep_bytes = keep_bytes
        self.deleted: tuple[str, ...] = ()
        """Names of all captures that made room."""
        self._robot = robot
        self._started = started
        self._reserve_bytes = reserve_bytes
        self._free_bytes = free_bytes

    def place(self, number: int) -> Path:
        """The path of the nth file."""
        if self.keep_bytes is not None:
            self._make_room(self.keep_bytes)
        return self.folder / file_name(self._robot, self._started, number, self.label)

    def _make_room(self, keep_bytes: int) -> None:
        kept = make_room(self.folder, self._robot, keep_bytes, self._started)
        with suppress(OSError):
            if (short := self._reserve_bytes - self._free_bytes(self.folder)) > 0:
                more = make_room(self.folder, self._robot, kept.kept_bytes - short, self._started)
                kept = KeptCaptures([*kept.gone, *more.gone], more.kept_bytes)
        self.kept_bytes = kept.kept_bytes
        self.deleted = (*self.deleted, *(path.name for path in kept.gone))
