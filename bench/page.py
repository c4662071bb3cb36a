"""Writes docs/benchmarks.md and its charts from the stored results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.report import Chart, Figure, Result, number
from bench.suite import ROOT, STORED, names, read

LONG = 40
"""Rows from which on a table is folded."""
PAGE = ROOT / "docs" / "benchmarks.md"
HEAD = """# Benchmarks

`make bench` runs all of them in under 20 minutes on two cores. The command beside each runs it alone; `--json` prints
its result as JSON. `python -m bench page` writes this page from the stored results (`bench/results/`): no number in it
is typed in. Ratios compare things that took turns in one run, and hold on other machines; absolute times are those of
the machine that a section names. The middle 80% are the samples from the 10th to the 90th percentile. A bound is what
the project promises.
"""


def write(_arguments: Sequence[str] = ()) -> int:
    """Write the page and its charts. Exit code 1 without stored results."""
    stored = read(STORED)
    if not stored:
        print(f"no results in {STORED}: run `python -m bench suite` and `python -m bench store`")
        return 1
    order = [name for name in names([]) if name in stored]
    PAGE.write_text("\n".join([HEAD, *(section(stored[name]) for name in order)]))
    for name in order:
        for chart in stored[name].charts:
            draw(chart, PAGE.parent / picture(name, chart))
    print(f"wrote {PAGE.relative_to(ROOT)}")
    return 0


def picture(name: str, chart: Chart) -> str:
    """The file's name of a chart."""
    return f"benchmarks-{name}-{chart.name}.png"


def section(result: Result) -> str:
    """A bench's part of the page."""
    machine = result.machine
    lines = [f"## {result.bench.capitalize()}", "", result.about, "", f"`{result.command}`"]
    lines[-1] += (
        f", {result.seconds:.0f} s on {machine.cores} cores of {machine.processor}, Python {machine.python}, "
        f"{result.date}; other programs used {machine.busy_percent:.0f}% before it began."
    )
    lines.append("")
    for chart in result.charts:
        lines += [f"![{chart.title}]({picture(result.bench, chart)})", ""]
    if result.figures:
        lines += ["| figure | median | middle 80% | samples | bound |", "| --- | ---: | --- | ---: | --- |"]
        lines += map(_row, result.figures)
        lines.append("")
    for table in result.tables:
        long = len(table.rows) > LONG
        lines += [f"<details><summary>{table.title}</summary>" if long else f"{table.title}:", ""]
        lines += [f"| {' | '.join(table.head)} |", "| --- " * len(table.head) + "|"]
        lines += [f"| {' | '.join(row)} |" for row in table.rows]
        lines += ["", "</details>", ""] if long else [""]
    lines += [f"- {note}" for note in result.notes]
    return "\n".join(lines).rstrip() + "\n"


def _row(figure: Figure) -> str:
    bound = figure.bound + ("" if figure.kept else ": **missed**")
    unit = "" if figure.unit == "x" else f" {figure.unit}"
    around = "" if figure.low == figure.high else f"{number(figure.low)} to {number(figure.high)}"
    return f"| {figure.name} | {number(figure.median)}{unit} | {around} | {figure.count} | {bound} |"


def draw(chart: Chart, path: Path) -> None:
    """Draw a chart into a PNG. Needs the extra `experiments`."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(8.0, 4.0), dpi=110, layout="constrained")
    for series in chart.series:
        xs, middles, lows, highs = (list(values) for values in zip(*series.points, strict=True))
        (line,) = axes.plot(xs, middles, marker="o", label=series.name)
        axes.fill_between(xs, lows, highs, alpha=0.2, color=line.get_color(), linewidth=0)
    if chart.log_x:
        axes.set_xscale("log")
    if chart.log_y:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)
    axes.set(title=chart.title, xlabel=chart.x, ylabel=chart.y)
    axes.grid(visible=True, alpha=0.3)
    axes.legend()
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)
