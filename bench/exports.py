"""Measures the exports of a capture, size and processor time of each form: `python -m bench exports [FILE]`.

Without FILE two fetches are rehearsed for it.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from bench.report import Report, Table, number
from cocoro.errors import CocoroError

COCORO = [sys.executable, "-m", "apps.cli.main"]
FORMS = {
    "--foxglove": "fox.mcap",
    "--rrd": "out.rrd",
    "--video": "robot.mp4",
    "--video --camera both": "both.mp4",
    "--video --camera outside": "outside.webp",
    "--csv": "csv",
}
FETCHES = {
    "320x240 at 15 Hz": ["--frames", "320x240@15"],
    "640x480 at 30 Hz, real sensors": ["--sensors", "real"],
}
HEAD = ["form", "size, MB", "of the capture's", "processor time, s"]


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", nargs="?", type=Path, metavar="FILE", help="a capture")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if chosen.file is not None:
            _sizes(report, str(chosen.file), chosen.file, folder)
            return
        for turn, (name, settings) in enumerate([*FETCHES.items()][: 1 if chosen.short else None]):
            part = folder / str(turn)
            part.mkdir()
            _sizes(report, name, rehearsed(settings, part / "fetch.mcap"), part)


def _sizes(report: Report, name: str, file: Path, folder: Path) -> None:
    if not file.is_file():
        raise CocoroError(f"{file}: there is no such file")
    whole, rows, made = size_of(file), [], 0
    report.value(f"{name}: the capture", [whole / 1e6], "MB")
    for form, out_name in FORMS.items():
        out = folder / out_name
        option, *more = form.split()
        before_s = cpu_s()
        done = subprocess.run([*COCORO, "export", str(file), option, str(out), *more], capture_output=True, text=True)
        used_s = cpu_s() - before_s
        made += done.returncode == 0
        if done.returncode == 0:
            size = size_of(out)
            rows.append([form, number(size / 1e6), number(size / whole), number(used_s)])
        else:
            rows.append([form, done.stderr.strip(), "", ""])
        report.say("  ".join(rows[-1]))
    report.share(f"{name}: forms that could be made", made, len(FORMS))
    report.tables.append(Table(f"Exports of {name}", HEAD, rows))


def cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def size_of(path: Path) -> int:
    return path.stat().st_size if path.is_file() else sum(part.stat().st_size for part in path.rglob("*"))


def rehearsed(options: list[str], out: Path) -> Path:
    command = [*COCORO, "rehearse", "fetch", "red_can", "--seed", "3", *options, "--record", str(out)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return out
