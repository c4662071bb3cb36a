"""Tries every command that takes a capture on damaged captures: `python -m bench capture-damage [--times 1000]`.

Damages a second of a rehearsed fetch at random, repeatedly, and has each command read it. None may hang, fail
without an explanation, or find a message that was not recorded.
"""

from __future__ import annotations

import argparse
import io
import random
import tempfile
import time
from collections import defaultdict
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path

from apps.captures.rewrite import rewrite
from apps.cli.main import main as cocoro
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from bench.report import Report, Table
from bench.trials import Runs, number_of, sized
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture, Record
from cocoro.clock import NS
from services.capture.packing import Packer
from services.executive.tasks import FetchTask

HANGS_S = 60.0
"""A command that takes longer hangs."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--times", type=number_of, help="damages (1000)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    with tempfile.TemporaryDirectory(prefix="cocoro-") as folder:
        _damage(Path(folder), sized(chosen, chosen.times, 1000, 3), report)


def _damage(folder: Path, times: int, report: Report) -> None:
    """Run each command on damaged captures."""
    second, spoilt = folder / "second.mcap", folder / "spoilt.mcap"
    request = RehearsalRequest(
        task=FetchTask(label="red_can"), width=160, height=120, frame_rate_hz=10.0, record=str(folder / "whole.mcap")
    )
    rehearse(request)
    with Capture.open(folder / "whole.mcap") as capture:
        rewrite(capture, second, Packer("zstd"), start_ns=capture.start_ns, end_ns=capture.start_ns + NS)
    with Capture.open(second) as capture:
        recorded = {_fingerprint(each) for each in capture.messages()}
    data, draw = second.read_bytes(), random.Random(times)
    counts: dict[tuple[str, int], int] = defaultdict(int)
    runs, slowest_s = Runs(report), 0.0
    for number in range(times):
        spoilt.write_bytes(_spoilt(data, draw))
        commands = [
            ["capture", "info", str(spoilt), "--check"],
            ["capture", "repair", str(spoilt), "--out", str(folder / f"{number}.mcap")],
            ["capture", "reexecute", str(spoilt), "--service", "perception"],
            ["capture", "reexecute", str(spoilt), "--service", "planning"],
            ["export", str(spoilt), "--csv", str(folder / "csv"), "--foxglove", str(folder / f"{number}-fox.mcap")],
            ["export", str(spoilt), "--video", str(folder / f"{number}.mp4")],
        ]
        wrong = []
        for command in commands:
            said, started = io.StringIO(), time.monotonic()
            with redirect_stdout(said), redirect_stderr(said):
                code = cocoro(command)
            slowest_s = max(slowest_s, time.monotonic() - started)
            if code not in (0, 1) or "Traceback" in said.getvalue():
                wrong.append(f"{' '.join(command)}: exit code {code}: {said.getvalue()}")
            counts[" ".join(word for word in command if "/" not in word), code] += 1
        with suppress(CaptureError), Capture.open(spoilt) as capture:
            found = [_fingerprint(each) for each in capture.messages()]
            if not set(found) <= recorded or len(found) != len(set(found)):
                wrong.append("a message was read that was not recorded, or twice")
        for made in folder.glob(f"{number}*"):
            made.unlink()
        runs.add(not wrong, f"damage {number}", wrong)
    runs.share("every command ended in words, and nothing was found that was not recorded")
    report.value("the slowest command", [slowest_s], "s", at_most=HANGS_S)
    rows = [[words, str(code), str(count)] for (words, code), count in sorted(counts.items())]
    report.tables.append(Table("Ends of the commands", ["command", "exit code", "times"], rows))


def _fingerprint(record: Record) -> tuple[str, int, int, int, int]:
    return record.key, record.sequence, record.log_ns, record.publish_ns, hash(bytes(record.payload))


def _spoilt(whole: bytes, draw: random.Random) -> bytes:
    """Cut, flipped, zeroed, shortened or extended; of a closed or an unclosed file."""
    data = bytearray(whole if draw.random() < 0.5 else whole[: round(len(whole) * draw.uniform(0.2, 0.95))])
    at, length = draw.randrange(len(data)), draw.choice((1, 8, 600, 5000))
    kind = draw.choice(("cut", "flip", "flip", "blank", "take", "put"))
    if kind == "cut":
        del data[at:]
    elif kind == "flip":
        for _ in range(draw.choice((1, 1, 2, 8))):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    elif kind == "blank":
        data[at : at + length] = bytes(len(data[at : at + length]))
    elif kind == "take":
        del data[at : at + length]
    else:
        data[at:at] = draw.randbytes(length)
    return bytes(data)
