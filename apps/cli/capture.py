"""`cocoro capture`: list captures, look at them, keep or remove them, repair them, re-execute a service on them."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from apps.captures import shelf as captures
from apps.captures.info import AttachmentReport, CaptureReport, report
from apps.captures.rewrite import REPAIRED, rewrite
from apps.cli import completions, exits, shelf
from apps.cli.options import (
    CaptureArgument,
    FromOption,
    JsonOption,
    OnlyOption,
    ToOption,
    WithoutOption,
    capture_file,
    name_option,
)
from apps.cli.output import print_json
from apps.cli.terminal import Column, fields, table
from cocoro.capture.conventions import CaptureError
from cocoro.capture.occasion import OCCASION, Occasion
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.errors import ConfigError, choice_of
from services.capture.keys import KeyFilter
from services.capture.log_clock import WALL_CLOCK, WallClockStep, describe_step
from services.capture.packing import COMPRESSIONS, Compression, Packer

MB = 1e6
COLUMNS = (
    "key", Column("type", 4), Column("messages", right=True), Column("rate", 3, right=True),
    Column("size", right=True), Column("longest gap", 2), Column("lost", 1, right=True),
    Column("dropped", 1, right=True),
)  # fmt: skip

LATENCY_COLUMNS = (
    "stage", Column("median ms", right=True), Column("99% ms", right=True), Column("worst ms", right=True),
)  # fmt: skip

app = typer.Typer()
capture = typer.Typer(no_args_is_help=True, help="List captures, look at them, keep, repair and re-execute them.")
app.add_typer(capture, name="capture")

capture.command("list")(shelf.list_captures)
capture.command()(shelf.pin)
capture.command()(shelf.unpin)
capture.command()(shelf.remove)

# --- info -----------------------------------------------------------------------------------------


@capture.command()
def info(
    file: CaptureArgument,
    check: Annotated[
        bool, typer.Option("--check", help="Read every byte instead of trusting the file's summary.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Contents of a capture: keys, counts, rates, gaps, losses and its origin. Exit code 1 when it is damaged."""
    sys.exit(show_info(file, check, json))


def show_info(file: Path, check: bool, as_json: bool) -> int:
    """Prints what a capture has and returns the exit code. Raises CaptureError for a file that is no capture."""
    with Capture.open(file) as capture:
        found = report(capture, check)
    print(msgspec.json.encode(found).decode() if as_json else text(found), end="\n" if as_json else "")
    return exits.FAILED if found.problems else exits.DONE


def text(found: CaptureReport) -> str:
    several = Counter(key.key for key in found.keys)
    names = {key.channel: key.key if several[key.key] == 1 else f"{key.key}#{key.channel}" for key in found.keys}
    names = {channel: name.removeprefix(f"{found.robot}/") for channel, name in names.items()}
    rows = [
        (
            names[key.channel], key.type, str(key.messages), f"{key.rate_hz:.1f} Hz", f"{key.size_bytes / MB:.2f} MB",
            f"{key.longest_gap_s:.3f} s at {key.longest_gap_from_s:.1f}" if key.longest_gap_s else "",
            str(key.lost or ""), str(key.dropped or ""),
        )
        for key in found.keys
    ]  # fmt: skip
    return "\n".join(
        [
            *_head(found),
            "",
            table(COLUMNS, rows).rstrip(),
            *(f"{names[key.channel]}: {change}" for key in found.keys for change in key.changed),
            *(f"attachment: {_attachment(each)}" for each in found.attachments),
            *(f"note: {note}" for note in found.notes),
            *(f"damaged: {problem}" for problem in found.problems),
            "",
        ]
    )


def _attachment(found: AttachmentReport) -> str:
    media = f", {found.media_type}" if found.media_type else ""
    return f"{found.name}{media}, {found.size_bytes} bytes"


def _head(found: CaptureReport) -> list[str]:
    run = found.metadata.get("run", {})
    unix = run.get("log_clock", "unix") == "unix"
    start = datetime.fromtimestamp(found.start_ns / NS, UTC).isoformat(timespec="milliseconds") if unix else "0"
    services = sorted(name.partition("/")[2] for name in found.metadata if name.startswith("service/"))
    versions = run.get("versions", {})
    repaired = found.metadata.get(REPAIRED, {})
    lines = [
        ("file", found.path),
        ("robot", found.robot or "unknown"),
        ("started", start if found.messages else ""),
        ("lasts", f"{found.duration_s:.3f} s"),
        ("happened", _happened(found.metadata.get(OCCASION, {}))),
        ("clock", "; ".join(_clock_steps(found))),
        ("messages", f"{found.messages}"),
        ("size", f"{found.size_bytes / MB:.1f} MB, of {found.raw_bytes / MB:.1f} MB of payloads"),
        ("state", _state(found)),
        ("made of", "; ".join(_repaired(repaired))),
        ("recorder", " on ".join(filter(None, (run.get("recorder", ""), run.get("host", ""))))),
        ("services", ", ".join(services)),
        ("files", "; ".join(_files(found))),
        ("versions", ", ".join(f"{name} {version}" for name, version in versions.items())),
        ("metadata", ", ".join(found.metadata)),
    ]
    return fields(lines).splitlines()


def _happened(occasion: Mapping[str, Any]) -> str:
    """The task or other occasion for which the capture was made, its outcome, and the faults meanwhile."""
    try:
        found = msgspec.convert(occasion, Occasion, strict=False)
    except msgspec.ValidationError:  # none, or another program's metadata of this name
        return ""
    outcome = ": ".join(filter(None, (found.outcome, found.reason)))
    notes = [note.text for note in found.notes if note.text != found.what]
    return "; ".join(filter(None, (f"{found.what}{f' ({outcome})' if outcome else ''}", *notes[:3])))


def _clock_steps(found: CaptureReport) -> list[str]:
    """The steps of the wall clock while the capture was recorded, in words; times from the capture's start."""
    try:
        steps = msgspec.convert(found.metadata.get(WALL_CLOCK, {}).get("steps", ()), tuple[WallClockStep, ...])
    except msgspec.ValidationError:  # another program's metadata of this name
        return []
    found_steps = []
    for step in steps:
        at_s = (step.log_ns - found.start_ns) / NS
        when = f"at {at_s:.3f} s" if at_s >= 0 else f"{-at_s:.3f} s before this file began"
        found_steps.append(f"{describe_step(step)} {when}")
    return found_steps


def _state(found: CaptureReport) -> str:
    if found.problems:
        return "damaged; the readable part is below"
    if not found.closed:
        return f"{found.ending}; everything in it is readable"
    return "whole, every byte read" if found.checked else "whole"


def _repaired(repaired: Mapping[str, Any]) -> list[str]:
    """The file that this capture was repaired from, and what was missing in it."""
    if not repaired:
        return []
    ending = f"{repaired.get('file', '')}, which was {repaired.get('ending') or 'damaged'}"
    return [ending, *map(str, repaired.get("problems") or ())]


def _files(found: CaptureReport) -> list[str]:
    """The files that services were configured with, and their fingerprints."""
    return [
        f"{name.partition('/')[2]} {file['field']} {file['path']} (sha256 {file['sha256'][:12]})"
        for name, entries in found.metadata.items()
        if name.startswith("service/")
        for file in entries.get("files", ())
    ]


# --- repair ---------------------------------------------------------------------------------------


@capture.command()
def repair(
    file: CaptureArgument,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="The new file; FILE.repaired.mcap by default.")
    ] = None,
    compression: Annotated[
        str,
        name_option("zstd", "lz4", "none", help="Compression of the new file."),
    ] = "zstd",
    level: Annotated[int, typer.Option(min=1, max=19, help="Level for zstd; 19 is small and slow.")] = 1,
    only: OnlyOption = None,
    without: WithoutOption = None,
    start: FromOption = None,
    end: ToOption = None,
    json: JsonOption = False,
) -> None:
    """Write everything readable of a damaged or unfinished capture into a whole one; the old file stays."""
    sys.exit(repair_file(file, out, compression, level, only or [], without or [], start, end, json))


def repair_file(
    file: Path,
    out: Path | None,
    compression: str,
    level: int,
    only: list[str],
    without: list[str],
    start_s: float | None,
    end_s: float | None,
    as_json: bool = False,
) -> int:
    """Writes the new capture, prints what is missing in it, and returns the exit code.

    `start_s` and `end_s` are seconds from the capture's start. Raises CaptureError for a file that cannot be read or
    written, ConfigError for an impossible option.
    """
    packer = Packer(_compression(compression), level)
    with Capture.open(file) as capture:
        part = only or without or start_s is not None or end_s is not None
        if out is None and not part and capture.follows_conventions and _is_whole(file):
            if as_json:
                print_json({"path": str(file), "whole": True})
            else:
                print(f"{file}: it is whole, so there is nothing to repair; --out FILE writes a copy all the same")
            return exits.DONE
        key_filter = KeyFilter(capture.robot, only, without)
        check_span(capture, start_s, end_s)
        done = rewrite(
            capture,
            out or file.with_suffix(".repaired.mcap"),
            packer,
            keep=(lambda record: record.key in key_filter) if only or without else None,
            start_ns=_at(capture, start_s),
            end_ns=_at(capture, end_s),
        )
    if as_json:
        print_json(msgspec.to_builtins(done, enc_hook=str) | {"was": capture.ending})
        return exits.DONE
    attachments = f", {done.attachments} attachments" if done.attachments else ""
    print(f"{done.path}: {done.messages} messages{attachments}, {done.size_bytes / 1e6:.1f} MB")
    for problem in done.problems:
        print(f"missing: {problem}")
    for note in done.notes:
        print(f"left out: {note}")
    if capture.ending:
        print(f"note: {file} was {capture.ending}")
    return exits.DONE


def _is_whole(file: Path) -> bool:
    """Whether a capture is closed and undamaged, by every byte."""
    with Capture.open(file) as capture:
        if capture.whole:
            capture.check()
        return capture.whole


def _at(capture: Capture, seconds: float | None) -> int | None:
    return None if seconds is None else capture.start_ns + round(seconds * NS)


def _compression(text: str) -> Compression:
    for known in COMPRESSIONS:
        if text == known:
            return known
    raise ConfigError(f"--compression {text}: {choice_of(text, COMPRESSIONS)}")


def check_span(capture: Capture, start_s: float | None, end_s: float | None) -> None:
    """Checks `--from` and `--to`, in seconds from the capture's start. Raises ConfigError for an impossible one."""
    length_s = (capture.end_ns - capture.start_ns) / NS
    for option, given_s in (("--from", start_s), ("--to", end_s)):
        if given_s is not None and not (isfinite(given_s) and given_s >= 0):
            raise ConfigError(f"{option} {given_s:g}: give seconds from the capture's start, 0 or more")
    if start_s is not None and start_s > length_s:
        raise ConfigError(
            f"--from {start_s:g}: {capture.path} lasts {length_s:.3f} s, so there is nothing from there on"
        )
    if end_s is not None and end_s <= (start_s or 0.0):
        before = "the capture's start" if not start_s else f"--from {start_s:g}"
        raise ConfigError(
            f"--to {end_s:g}: it is exclusive and must be later than {before}, or there is nothing between"
        )


# --- re-execute -----------------------------------------------------------------------------------


@capture.command("rerun", hidden=True)
@capture.command()
def reexecute(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE...", parser=capture_file, help="The captures of one run, in order."),
    ],
    service: Annotated[
        str,
        typer.Option(
            "--service", autocompletion=completions.services, help="perception, planning, or another with a pure core."
        ),
    ],
    against: Annotated[
        str,
        name_option("recorded", "nothing", help="What to compare the outputs with."),
    ] = "recorded",
    tolerance: Annotated[
        float,
        typer.Option(min=0.0, max=0.1, help="Allowed difference of numbers, relative above 1; 0 compares exactly."),
    ] = 0.0,
    run: Annotated[
        bool,
        typer.Option("--run", help="Begin where the run began: take the files before FILE, too."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Execute a service again on the inputs that it had then, and compare its outputs. Exit code 1 when they differ."""
    if run:
        files = list(dict.fromkeys(each for file in files for each in captures.run_until(file)))
    sys.exit(reexecute_service(files, service, against, tolerance, json))


def reexecute_service(files: list[Path], service: str, against: str, tolerance: float, as_json: bool) -> int:
    """Prints the comparison and returns the exit code.

    Raises CaptureError when the captures lack inputs that the service needs, ConfigError for an impossible option.
    """
    from apps.captures import reexecute as reexecution

    if against not in ("recorded", "nothing"):
        raise ConfigError(f"--against {against}: {choice_of(against, ('recorded', 'nothing'))}")
    with ExitStack() as stack:
        opened = [stack.enter_context(Capture.open(file)) for file in files]
        if len({capture.robot for capture in opened}) > 1:
            raise CaptureError(
                f"captures of several robots ({', '.join(sorted({c.robot for c in opened}))}): give those of one run"
            )
        result = reexecution.reexecute(opened, service, tolerance, compare=against == "recorded")
    for capture in opened:
        if capture.ending:
            print(f"note: {capture.path} was {capture.ending}", file=sys.stderr)
    if as_json:
        print_json(msgspec.to_builtins(result))
    else:
        print("\n".join(reexecution.describe_result(result)))
    bad = result.differing or result.problems or (against == "recorded" and not result.equal)
    return exits.FAILED if bad else exits.DONE


# --- from pixel to motor --------------------------------------------------------------------------


@capture.command("latency")
def latency_of(file: CaptureArgument, json: JsonOption = False) -> None:
    """How long the robot took from a frame to the first wheel command that used it, by stages."""
    sys.exit(show_latency(file, json))


def show_latency(file: Path, as_json: bool) -> int:
    """Prints the times and returns the exit code: 1 when no frame led to a wheel command. Raises CaptureError when the
    capture lacks the frames, the detections or the planner's steps."""
    from apps.captures.latency import latency

    with Capture.open(file) as capture:
        found = latency([capture])
    if as_json:
        print_json(msgspec.to_builtins(found))
        return exits.DONE if found.stages else exits.FAILED
    rows = [(one.name, *(f"{ms:.1f}" for ms in (one.median_ms, one.p99_ms, one.worst_ms))) for one in found.stages]
    if rows:
        print(table(LATENCY_COLUMNS, rows))
    print(f"{found.frames} frames, {found.seen} became detections, {found.used} led to a wheel command")
    return exits.DONE if found.stages else exits.FAILED
