"""`cocoro capture info`: what a capture has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from apps.captures.info import AttachmentReport, Report, report
from apps.captures.rewrite import REPAIRED
from apps.cli import exits
from apps.cli.table import table
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from services.capture.log_clock import WALL_CLOCK, Step, words

MB = 1e6


def info(file: Path, check: bool, as_json: bool) -> int:
    with Capture.open(file) as capture:
        found = report(capture, check)
    print(msgspec.json.encode(found).decode() if as_json else text(found), end="\n" if as_json else "")
    return exits.FAILED if found.problems else exits.DONE


def text(found: Report) -> str:
    several = Counter(key.key for key in found.keys)
    names = {key.channel: key.key if several[key.key] == 1 else f"{key.key}#{key.channel}" for key in found.keys}
    rows = [
        (
            names[key.channel], key.type, str(key.messages), f"{key.rate_hz:.1f} Hz", f"{key.size_bytes / MB:.2f} MB",
            f"{key.longest_gap_s:.3f} s at {key.longest_gap_from_s:.1f}" if key.longest_gap_s else "",
            str(key.lost or ""), str(key.dropped or ""),
        )
        for key in found.keys
    ]  # fmt: skip
    heads = ("key", "type", "messages", "rate", "size", "longest gap", "lost", "dropped")
    return "\n".join(
        [
            *_head(found),
            "",
            table(heads, rows).rstrip(),
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


def _head(found: Report) -> list[str]:
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
        ("clock", "; ".join(_steps(found))),
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
    return [f"{name:<9} {value}" for name, value in lines if value]


def _steps(found: Report) -> list[str]:
    """How somebody set the wall clock while it was recorded; times since the capture's start."""
    try:
        steps = msgspec.convert(found.metadata.get(WALL_CLOCK, {}).get("steps", ()), tuple[Step, ...])
    except msgspec.ValidationError:  # somebody else's record of this name
        return []
    told = []
    for step in steps:
        at_s = (step.log_ns - found.start_ns) / NS
        when = f"at {at_s:.3f} s" if at_s >= 0 else f"{-at_s:.3f} s before this file began"
        told.append(f"{words(step)} {when}")
    return told


def _state(found: Report) -> str:
    if found.problems:
        return "damaged: what can be read is below"
    if not found.closed:
        return f"{found.ending}; all else that is there is readable"
    return "whole, every byte read" if found.checked else "whole"


def _repaired(repaired: Mapping[str, Any]) -> list[str]:
    """What is missing in a capture that was made of one that was not whole."""
    if not repaired:
        return []
    ending = f"{repaired.get('file', '')}, which was {repaired.get('ending') or 'damaged'}"
    return [ending, *map(str, repaired.get("problems") or ())]


def _files(found: Report) -> list[str]:
    """The files that services were configured with, by their fingerprints."""
    return [
        f"{name.partition('/')[2]} {file['field']} {file['path']} (sha256 {file['sha256'][:12]})"
        for name, entries in found.metadata.items()
        if name.startswith("service/")
        for file in entries.get("files", ())
    ]
