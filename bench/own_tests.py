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
    if idle_s := memory.get("idle_s"):
        report.value("processor time that nobody used", [idle_s[-1] - idle_s[0]], "s")
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
    head = ["from, s", "MB", "cores idle", "most of it for"]
    report.tables.append(Table("memory over time", head, _over_time(memory["looks"], memory.get("idle_s", []))))


def _over_time(looks: list[tuple[float, float, dict[str, float]]], idle_s: list[float]) -> list[list[str]]:
    """The look with the largest sum of each `SLICE_S`, for which files of tests the memory was, and how many cores were
    idle in the mean until the next slice."""
    highest: dict[int, tuple[float, float, dict[str, float]]] = {}
    first: dict[int, int] = {}
    for number, look in enumerate(looks):
        part = int(look[0] // SLICE_S)
        first.setdefault(part, number)
        if part not in highest or highest[part][1] < look[1]:
            highest[part] = look
    ends = [*first.values(), len(looks) - 1][1:]
    rows = []
    for (part, (_, total_mb, parts)), end in zip(highest.items(), ends, strict=True):
        largest = sorted(parts.items(), key=lambda one: -one[1])[:NAMED]
        words = ", ".join(f"{Path(name.partition(' -')[0]).name} {size:.0f}" for name, size in largest)
        rows.append([f"{part * SLICE_S:.0f}", f"{total_mb:.0f}", _idle(looks, idle_s, first[part], end), words])
    return rows


def _idle(looks: list[tuple[float, float, dict[str, float]]], idle_s: list[float], begin: int, end: int) -> str:
    """Idle cores between two looks; nothing where the record does not say."""
    seconds = looks[end][0] - looks[begin][0]
    return f"{(idle_s[end] - idle_s[begin]) / seconds:.1f}" if idle_s and seconds > 0 else ""


def _sum(files: dict[str, dict[str, float]], name: str) -> float:
    return sum(figures[name] for figures in files.values())


def _row(figures: dict[str, float]) -> list[str]:
    return [
        f"{figures['tests']:.0f}",
        f"{figures['wall_s']:.1f}",
        f"{figures['processor_s']:.1f}",
        f"{figures['memory_mb']:.0f}",
    ]
