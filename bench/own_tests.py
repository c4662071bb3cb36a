"""The project's own tests: what each file takes and the memory of all, by the record of the last `make test`.

`--run` runs them first, for minutes. A file's processor time has that of the processes that its tests waited for, not
that of detached ones.
"""

from __future__ import annotations

import json
import subprocess
from argparse import ArgumentParser, Namespace
from collections import defaultdict
from pathlib import Path

from bench.report import Report, Table

ROOT = Path(__file__).parent.parent
RECORD = ROOT / "out" / "tests" / "last"
SHOWN = 25
SLICE_S, NAMED = 15.0, 5
"""Memory over time: seconds of a row, and how many files of tests it names."""
WALL_S, MEMORY_MB = 360.0, 1000.0
"""Upper bounds, on two cores that do nothing else."""


def options(parser: ArgumentParser) -> None:
    parser.add_argument("--run", action="store_true", help="run the tests now (make test)")


def measure(chosen: Namespace, report: Report) -> None:
    if chosen.run:
        subprocess.run([ROOT / "deploy" / "test.sh"], cwd=ROOT, check=False)
    if not RECORD.is_dir():
        report.notes.append("There is no record: run `make test`, or give --run.")
        return
    files: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for part in sorted(RECORD.glob("pytest-*.json")):
        run = json.loads(part.read_text())
        report.notes.append(f"{run['wall_s']:.0f} s: pytest {' '.join(run['arguments'])}")
        for file, figures in run["files"].items():
            for name, value in figures.items():
                before = files[file][name]
                files[file][name] = max(before, value) if name == "memory_mb" else before + value
    report.value("all tests", [float((RECORD / "seconds").read_text())], "s", at_most=WALL_S)
    memory = json.loads((RECORD / "memory.json").read_text())
    report.value("memory of all their processes, at its peak", [memory["peak_mb"]], "MB", at_most=MEMORY_MB)
    report.value("processor time of the tests and of what they waited for", [_sum(files, "processor_s")], "s")
    report.value("tests", [_sum(files, "tests")], "")
    longest = sorted(files.items(), key=lambda one: -one[1]["wall_s"])
    others = dict(longest[SHOWN:])
    rows = [[Path(file).name, *_row(figures)] for file, figures in longest[:SHOWN]]
    if others:
        names = ("tests", "wall_s", "processor_s")
        summed = {name: _sum(others, name) for name in names}
        summed["memory_mb"] = max(figures["memory_mb"] for figures in others.values())
        rows.append([f"{len(others)} others", *_row(summed)])
    report.tables.append(Table("files of tests", ["file", "tests", "wall, s", "processor, s", "pytest, MB"], rows))
    largest = [[name, test, f"{size:.0f}"] for name, size, test in memory["largest"]]
    peak = f"processes at the peak, after {memory['at_s']:.0f} s"
    report.tables.append(Table(peak, ["process", "for the test", "MB"], largest))
    report.tables.append(Table("memory over time", ["from, s", "MB", "most of it for"], _over_time(memory["looks"])))


def _over_time(looks: list[tuple[float, float, dict[str, float]]]) -> list[list[str]]:
    """The look with the largest sum of each `SLICE_S`, and for which files of tests the memory was."""
    highest: dict[int, tuple[float, float, dict[str, float]]] = {}
    for look in looks:
        part = int(look[0] // SLICE_S)
        if part not in highest or highest[part][1] < look[1]:
            highest[part] = look
    rows = []
    for part, (_, total_mb, parts) in sorted(highest.items()):
        largest = sorted(parts.items(), key=lambda one: -one[1])[:NAMED]
        words = ", ".join(f"{Path(name.partition(' -')[0]).name} {size:.0f}" for name, size in largest)
        rows.append([f"{part * SLICE_S:.0f}", f"{total_mb:.0f}", words])
    return rows


def _sum(files: dict[str, dict[str, float]], name: str) -> float:
    return sum(figures[name] for figures in files.values())


def _row(figures: dict[str, float]) -> list[str]:
    return [
        f"{figures['tests']:.0f}",
        f"{figures['wall_s']:.1f}",
        f"{figures['processor_s']:.1f}",
        f"{figures['memory_mb']:.0f}",
    ]
