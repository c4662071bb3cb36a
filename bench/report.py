"""What a bench says: figures with their spread and bounds, charts and notes, in one format.

An entry of `bench/entries.py` is a module with a function `measure(chosen, report)`, and `options(parser)` where it has
options of its own. The first line of its docstring says what it measures. `chosen` has the parsed options and `short`:
the short form takes seconds, measures the same ratios with fewer samples, and is what continuous integration runs.
`measure` gives its figures to the report:

    ours, plain = turns(20, ours=detect, plain=detect_plainly)
    report.value("detector, 16 objects", ours, "ms", at_most=2.5)
    report.ratio("plain OpenCV / ours, 64 objects", plain, ours, at_least=10.0)

A ratio is of two things that took turns in this run: it alone can be compared between machines, and against the stored
figure. A bound is a promise of the project: one that is not kept ends the bench with exit code 1.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterable, Sequence
from math import isfinite
from pathlib import Path
from statistics import median, quantiles
from typing import Literal, TypeVar

import msgspec
import psutil

T = TypeVar("T")


class Figure(msgspec.Struct, frozen=True, omit_defaults=True):
    """A measured quantity: the median of `count` samples, and the range that holds the middle 80 percent of them."""

    name: str
    unit: str
    """A unit, "x" for a ratio, or "%" for a share."""
    median: float
    low: float
    high: float
    count: int
    at_most: float | None = None
    at_least: float | None = None
    better: Literal["less", "more", ""] = ""
    """Which direction is better; ratios have one."""

    @property
    def kept(self) -> bool:
        """Whether the median keeps the bounds."""
        below = self.at_most is None or self.median <= self.at_most
        return below and (self.at_least is None or self.median >= self.at_least)

    @property
    def bound(self) -> str:
        """The bounds in words; empty without one."""
        said = [("at most", self.at_most), ("at least", self.at_least)]
        return ", ".join(f"{words} {number(value)}" for words, value in said if value is not None)


class Series(msgspec.Struct, frozen=True):
    """A line of a chart: points of x, median, low and high."""

    name: str
    points: list[tuple[float, float, float, float]]


class Chart(msgspec.Struct, frozen=True):
    """A chart of the page: a line for each series."""

    name: str
    """Part of its file's name."""
    title: str
    x: str
    y: str
    series: list[Series]
    log_x: bool = False
    log_y: bool = False


class Table(msgspec.Struct, frozen=True):
    """Rows that are no single figures, as text."""

    title: str
    head: list[str]
    rows: list[list[str]]


class Machine(msgspec.Struct, frozen=True):
    """Where and beside what a bench ran."""

    processor: str
    cores: int
    memory_gb: float
    system: str
    python: str
    busy_percent: float
    """Share of all cores that other programs used in the second before the bench."""


class Result(msgspec.Struct, frozen=True):
    """Everything that a run of a bench said."""

    bench: str
    about: str
    command: str
    form: Literal["full", "short"]
    date: str
    commit: str
    seconds: float
    machine: Machine
    figures: list[Figure]
    charts: list[Chart] = []
    tables: list[Table] = []
    notes: list[str] = []

    @property
    def kept(self) -> bool:
        """Whether each figure keeps its bounds."""
        return all(figure.kept for figure in self.figures)


class Report:
    """Collects what a bench says. Raises ValueError for a figure without samples, with one that is not finite, or
    with a name that is taken."""

    def __init__(self, say: Callable[[str], None] = lambda _: None) -> None:
        self.figures: list[Figure] = []
        self.charts: list[Chart] = []
        self.tables: list[Table] = []
        self.notes: list[str] = []
        self.say = say
        """Prints a line of progress, which is no part of the result."""

    def value(
        self,
        name: str,
        samples: Sequence[float],
        unit: str,
        *,
        at_most: float | None = None,
        at_least: float | None = None,
    ) -> Figure:
        """A quantity by its samples."""
        return self._add(Figure(name, unit, *spread(name, samples), at_most, at_least))

    def ratio(
        self,
        name: str,
        over: Sequence[float],
        under: Sequence[float],
        *,
        at_most: float | None = None,
        at_least: float | None = None,
        better: Literal["less", "more"] | None = None,
    ) -> Figure:
        """The ratio of two quantities whose samples were taken in turns: over[i] and under[i] belong together. Raises
        ValueError for unequal lengths, for a denominator of zero, or where neither a bound nor `better` says which
        direction is better."""
        direction = better or ("less" if at_most is not None else "more" if at_least is not None else None)
        if direction is None:
            raise ValueError(f"{name}: say whether less or more is better")
        if len(over) != len(under) or not all(under):
            raise ValueError(f"{name}: {len(over)} samples over {len(under)}, of which none may be 0")
        ratios = [a / b for a, b in zip(over, under, strict=True)]
        return self._add(Figure(name, "x", *spread(name, ratios), at_most, at_least, direction))

    def share(self, name: str, good: int, count: int, *, at_least: int | None = None) -> Figure:
        """How many of `count` trials were good, in percent. `at_least` is a number of trials out of `count`."""
        percent = 100.0 * good / count
        bound = None if at_least is None else 100.0 * at_least / count
        return self._add(Figure(name, "%", percent, percent, percent, count, None, bound))

    def _add(self, figure: Figure) -> Figure:
        if any(figure.name == other.name for other in self.figures):
            raise ValueError(f"{figure.name}: there is such a figure")
        self.figures.append(figure)
        self.say(f"{figure.name}: {said(figure)}")
        return figure


def spread(name: str, samples: Sequence[float]) -> tuple[float, float, float, int]:
    """Median, 10th and 90th percentile, and the number of samples. Raises ValueError without finite samples."""
    if not samples or not all(map(isfinite, samples)):
        raise ValueError(f"{name}: {len(samples)} samples, which must be finite and at least one")
    if len(samples) == 1:
        return samples[0], samples[0], samples[0], 1
    tenths = quantiles(samples, n=10, method="inclusive")
    return median(samples), tenths[0], tenths[-1], len(samples)


def percentile(samples: Sequence[float], percent: float) -> float:
    """A percentile of at least one sample, between samples by interpolation. `percent` is from 0 to 100."""
    ordered = sorted(samples)
    place = (len(ordered) - 1) * percent / 100.0
    below = int(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (ordered[above] - ordered[below]) * (place - below)


def turns(rounds: int, warm: int = 1, **things: Callable[[], T]) -> list[list[T]]:
    """Call each thing once in each round, beginning with another one in each round, so that the machine's other work
    affects all alike. Returns each thing's results, without those of the first `warm` rounds, in the order given."""
    names = list(things)
    results: dict[str, list[T]] = {name: [] for name in names}
    for turn in range(warm + rounds):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            result = things[name]()
            if turn >= warm:
                results[name].append(result)
    return [results[name] for name in names]


def timed(action: Callable[[], object], unit: Literal["s", "ms", "us"] = "ms") -> Callable[[], float]:
    """A function that returns how long a call of `action` took."""
    scale = {"s": 1e-9, "ms": 1e-6, "us": 1e-3}[unit]

    def measure() -> float:
        begun_ns = time.perf_counter_ns()
        action()
        return (time.perf_counter_ns() - begun_ns) * scale

    return measure


def this_machine() -> Machine:
    """This machine, and what other programs use of it now, measured for a second."""
    models = (
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    )
    return Machine(
        processor=next(models, platform.processor() or platform.machine()),
        cores=psutil.cpu_count() or 1,
        memory_gb=round(psutil.virtual_memory().total / 1e9, 1),
        system=f"{platform.system()} {platform.release()}",
        python=platform.python_version(),
        busy_percent=psutil.cpu_percent(interval=1.0),
    )


def number(value: float) -> str:
    """A number with three significant digits, without an exponent."""
    if value == 0 or abs(value) >= 100:
        return f"{value:,.0f}"
    digits = 2 if abs(value) >= 1 else 3
    text = f"{value:.{digits}f}" if abs(value) < 10 else f"{value:.1f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def said(figure: Figure) -> str:
    """A figure in words: median, unit and spread."""
    unit = "" if figure.unit == "x" else f" {figure.unit}"
    if figure.low == figure.high:
        return f"{number(figure.median)}{unit}"
    return f"{number(figure.median)}{unit} ({number(figure.low)} to {number(figure.high)})"


def worse(now: Figure, stored: Figure) -> bool:
    """Whether a ratio fell by more than a third against the stored one."""
    if now.better == "less":
        return now.median > stored.median * 1.5
    return now.median < stored.median / 1.5


def ratios(figures: Iterable[Figure]) -> dict[str, Figure]:
    """The figures that can be compared between machines, by name."""
    return {figure.name: figure for figure in figures if figure.better}


def encode(result: Result) -> str:
    """A result as JSON, indented."""
    return msgspec.json.format(msgspec.json.encode(result), indent=1).decode()


def decode(text: bytes, source: str) -> Result:
    """A result from JSON. Raises ValueError, which names `source`, for anything else."""
    try:
        return msgspec.json.decode(text, type=Result)
    except msgspec.DecodeError as error:
        raise ValueError(f"{source} is no result of a bench: {error}") from error
