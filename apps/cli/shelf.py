"""`cocoro capture list`, `pin`, `unpin` and `remove`: which captures there are, and which stay."""

from __future__ import annotations

import sys
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from apps.captures import shelf
from apps.captures.names import folders, open_captures
from apps.cli import exits
from apps.cli.options import JsonOption, capture_file
from apps.cli.output import complain, print_json
from apps.cli.terminal import Column, print_table
from cocoro.capture.conventions import CaptureError
from cocoro.capture.folder import IDLE, delete, is_pinned, pin_of
from cocoro.capture.listed import ListedCapture
from cocoro.clock import NS
from cocoro.errors import RefusedError
from deploy.rundir import robots

MB = 1e6
COLUMNS = (
    Column("name"), Column("began"), Column("lasts", 2, right=True), Column("size", 1, right=True), Column("pin", 3),
    Column("outcome"), Column("file", 4), Column("what", text=True),
)  # fmt: skip
FilesArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="FILE...",
        parser=capture_file,
        help="Captures: files, or names: latest, latest-1, fetch, 'fetch red_can'.",
    ),
]


def list_captures(
    robot: Annotated[str | None, typer.Option("--robot", help="Only captures of this robot.")] = None,
    count: Annotated[int, typer.Option("--count", "-n", min=1, metavar="N", help="The newest so many.")] = 30,
    everything: Annotated[bool, typer.Option("--all", help="All, also those in which nothing happened.")] = False,
    as_json: JsonOption = False,
) -> None:
    """The captures that recorders made on this machine, oldest first; JSON lists all."""
    found = list(shelf.listed(robot))
    if as_json:
        print_json(msgspec.to_builtins(found))
        return
    if not found:
        places = ", ".join(map(str, folders()))
        print(f"no captures{f' of {robot}' if robot else ''} in {places}")
        return
    shown = found if everything else [each for each in found if each.name.partition("-")[0] != IDLE][:count]
    if shown:
        print_table(COLUMNS, [_row(each) for each in reversed(shown)])
        print()
    print(_summary(found, len(shown)))


def _row(each: ListedCapture) -> tuple[str, ...]:
    began = f"{datetime.fromtimestamp(each.began_ns / NS):%Y-%m-%d %H:%M}" if each.began_ns else ""
    return (
        each.name,
        began,
        f"{each.duration_s:.0f} s" if each.closed else "",
        _size(each.size_bytes),
        "pinned" if each.pinned else "",
        _outcome(each),
        Path(each.file).name,
        each.what or "-",
    )


def _outcome(each: ListedCapture) -> str:
    if each.outcome:
        return each.outcome + (f": {each.reason.partition(':')[0]}" if each.reason else "")
    return "" if each.closed else "not closed"


def _summary(found: list[ListedCapture], shown: int) -> str:
    more = f"; {len(found) - shown} more, --all shows them" if shown < len(found) else ""
    pinned = sum(each.size_bytes for each in found if each.pinned)
    of_it = f", {_size(pinned)} of them pinned" if pinned else ""
    places = ", ".join(dict.fromkeys(str(Path(each.file).parent) for each in found))
    return f"{len(found)} captures, {_size(sum(each.size_bytes for each in found))}{of_it}, in {places}{more}"


def _size(size_bytes: int) -> str:
    return f"{size_bytes / 1e9:.1f} GB" if size_bytes >= 1e9 else f"{size_bytes / MB:.1f} MB"


def pin(files: FilesArgument, as_json: JsonOption = False) -> None:
    """Keep captures: the recorder never deletes them to make room, and they do not count for its limit."""
    sys.exit(_each(files, as_json, "pinned", lambda path: pin_of(path).touch()))


def unpin(files: FilesArgument, as_json: JsonOption = False) -> None:
    """Let the recorder delete captures again."""
    sys.exit(_each(files, as_json, "not pinned", lambda path: pin_of(path).unlink(missing_ok=True)))


def remove(
    files: FilesArgument,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Delete captures, after asking."""
    sys.exit(remove_captures(list({file.absolute(): file for file in files}.values()), yes, as_json))


def remove_captures(files: list[Path], yes: bool, as_json: bool) -> int:
    """Deletes captures; returns the exit code. Nothing is deleted when one of them must stay. Raises RefusedError for
    one that is pinned or is being written, CaptureError for what is no capture."""
    written = {path.resolve() for run_dir in robots() for path in open_captures(run_dir)}
    for path in files:
        _must_exist(path)
        if is_pinned(path):
            raise RefusedError(f"{path} is pinned; `cocoro capture unpin` comes first; nothing was removed")
        if path.resolve() in written:
            raise RefusedError(f"{path} is being written; `cocoro down` ends that; nothing was removed")
    size = _size(sum(path.stat().st_size for path in files))
    if not yes:
        if as_json or not sys.stdin.isatty():
            why = "--json asks no question" if as_json else "there is no terminal to ask at"
            complain(f"nothing was removed ({why}): repeat the command with --yes")
            return exits.REFUSED
        names = ", ".join(path.name for path in files)
        if input(f"remove {names} ({size})? [y/N] ").strip().lower() not in ("y", "yes"):
            complain("nothing was removed, as you answered")
            return exits.REFUSED
    return _each(files, as_json, "removed", delete)


def _each(files: list[Path], as_json: bool, word: str, work: Any) -> int:
    for path in files:
        _must_exist(path)
    for path in files:
        try:
            work(path)
        except OSError as error:
            raise CaptureError(f"{path}: {error.strerror or error}") from error
    if as_json:
        print_json({"files": [str(path) for path in files], "done": word})
    else:
        for path in files:
            print(f"{path}: {word}")
    return exits.DONE


def _must_exist(path: Path) -> None:
    if not path.is_file():
        raise CaptureError(f"{path}: no such file; `cocoro capture list` shows the captures")
    if path.suffix != ".mcap":
        raise CaptureError(f"{path} is no capture: its name does not end with .mcap")
