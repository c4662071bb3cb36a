"""The captures on this machine: names in place of their files, and what happened in each."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from apps.captures.names import LATEST, shelf
from cocoro.capture.folder import IDLE, captures, parsed_name
from cocoro.capture.listed import Ends, ListedCapture, listed_capture
from cocoro.capture.mcap import MAGIC

_COUNTED = re.compile(r"(?P<name>.+)-(?P<back>\d{1,4})")


def listed(robot: str | None = None) -> Iterator[ListedCapture]:
    """The captures of this machine, the newest first, each with what happened in it."""
    for name, path in shelf(robot):
        parsed = parsed_name(path)
        assert parsed is not None
        yield listed_capture(name, path, parsed)


def run_until(path: Path) -> list[Path]:
    """The captures of a file's run in its folder, in order, up to it; the file alone when no recorder named it."""
    wanted = parsed_name(path)
    if wanted is None:
        return [path]
    return [
        each
        for each in captures(path.parent, wanted.robot)
        if (name := parsed_name(each)) and name.run == wanted.run and name.number <= wanted.number
    ]


def find(text: str) -> Path:
    """The file of a name: a path, a file's name in the folder of captures, `latest` or `idle`, a task (`fetch`,
    `fetch red_can`), `stop`, `fault` or `motion`, each with `-N` for the Nth before it, or a task's id.

    A path comes first: a text with a folder, with the ending .mcap, or of an MCAP file in the current directory. A text
    that is none of these is returned as a path, so that reading it fails.
    """
    path = Path(text)
    with suppress(OSError, ValueError):
        if path.exists() and not path.is_dir() and (path.parts[:-1] or path.suffix == ".mcap" or _is_mcap(path)):
            return path
    there = shelf()
    for name, found in there:
        if text in (name, found.name):
            return found
    if text == LATEST and there:  # only such in which nothing happened
        return there[0][1]
    if (found_by := _by_label(text, there)) is not None:
        return found_by
    for _, found in there:
        if _label(found) in ("", IDLE):
            continue
        if (occasion := Ends(found).occasion) is not None and text == occasion.task_id:
            return found
    return path


def _is_mcap(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC


def _by_label(text: str, there: Sequence[tuple[str, Path]]) -> Path | None:
    """The newest capture of a task, with or without its target."""
    wanted = "-".join(text.split())
    counted = _COUNTED.fullmatch(wanted)
    tries = [(wanted, 0), *([(counted["name"], int(counted["back"]))] if counted else [])]
    for name, back in tries:
        found = [path for _, path in there if name == (label := _label(path)) or label.startswith(f"{name}-")]
        if back < len(found):
            return found[back]
    return None


def _label(path: Path) -> str:
    name = parsed_name(path)
    return "" if name is None else name.label
