"""Runs the benches: `python -m bench` lists them, `python -m bench NAME [--json] [--short]` runs one.

    python -m bench suite [--short] [NAME ...]         # what `make bench` runs: one after another, results in out/bench
    python -m bench store [NAME ...]                   # keeps results of out/bench in bench/results
    python -m bench page                               # writes docs/benchmarks.md and its charts from bench/results
    python -m bench check                              # the short forms; no ratio may fall by more than a third

Exit code 1 when a figure does not keep its bound, a bench failed, or a ratio fell against the stored one.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bench import entries, page, suite
from bench.ended import leave_when_ended
from bench.report import Report, Result, encode, said, this_machine
from cocoro.errors import CocoroError

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy; small matrices only wait for a second thread

WORDS: dict[str, Callable[[Sequence[str]], int]] = {
    "suite": suite.run_suite,
    "store": suite.store,
    "page": page.write,
    "check": suite.check,
}


def show(result: Result) -> None:
    """Print a result as a person reads it."""
    console = Console(width=None if sys.stdout.isatty() else 140)
    table = Table("figure", "median (middle 80%)", "samples", "bound", "", title_justify="left")
    table.title = escape(result.about)
    for figure in result.figures:
        bounded = bool(figure.bound)
        verdict = "" if not bounded else "kept" if figure.kept else "[red]MISSED[/red]"
        table.add_row(escape(figure.name), said(figure), str(figure.count), figure.bound, verdict)
    console.print(table)
    for shown in result.tables:
        rows = Table(*map(escape, shown.head), title=escape(shown.title), title_justify="left")
        for row in shown.rows:
            rows.add_row(*map(escape, row))
        console.print(rows)
    for note in result.notes:
        console.print(f"- {note}", markup=False)
    machine = result.machine
    console.print(
        f"{machine.cores} cores of {machine.processor}, Python {machine.python}; others used "
        f"{machine.busy_percent:.0f}% of all cores before; {result.seconds:.0f} s",
        markup=False,
    )


def _commit() -> str:
    """The commit, with a mark where files differ from it; empty outside a repository."""
    asked = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=False)
    return asked.stdout.strip()


def run(name: str, arguments: Sequence[str]) -> int:
    """Run one bench by name."""
    entry = entries.ENTRIES[name]
    parser = argparse.ArgumentParser(f"python -m bench {name}", description=entry.about)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--short", action="store_true", help="the same ratios with fewer samples, in seconds")
    entry.options(parser)
    chosen = parser.parse_args(arguments)
    leave_when_ended()
    report = Report(lambda line: print(line, file=sys.stderr, flush=True))
    machine, begun_s = this_machine(), time.monotonic()
    try:
        entry.load().measure(chosen, report)
    except CocoroError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    result = Result(
        bench=name,
        about=entry.about,
        command=" ".join(["python -m bench", name, *(word for word in arguments if word != "--json")]),
        form="short" if chosen.short else "full",
        date=datetime.now(UTC).strftime("%Y-%m-%d"),
        commit=_commit(),
        seconds=round(time.monotonic() - begun_s, 1),
        machine=machine,
        figures=report.figures,
        charts=report.charts,
        tables=report.tables,
        notes=report.notes,
    )
    if chosen.json:
        print(encode(result))
    else:
        show(result)
    return 0 if result.kept else 1


def main() -> int:
    """The command."""
    word, *rest = sys.argv[1:] or [""]
    try:
        if word in entries.ENTRIES:
            return run(word, rest)
        if word in WORDS:
            return WORDS[word](rest)
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    print(__doc__)
    for kind, title in (("suite", "Run by `make bench`:"), ("trial", "Trials, with options of their own:")):
        print(title)
        for name, entry in sorted(entries.ENTRIES.items()):
            if entry.kind == kind:
                print(f"  {name:<18} {entry.about}")
    if word and word not in ("-h", "--help"):
        print(f"There is no bench {word!r}.", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
