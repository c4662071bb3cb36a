"""Results of an experiment: statistics over runs, rows of a table, plots and notes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import sqrt
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import scipy  # loads its parts when they are needed: `scipy.stats` takes 16 MB

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Best = Literal["low", "high", "zero"]


class Summary(NamedTuple):
    """Statistics of one measure over the seeds or runs; NaN where there are too few values."""

    mean: float
    ci95: float
    """Half the width of the mean's 95% confidence interval (Student's t); needs two values."""
    worst: float
    runs: int
    sd: float = float("nan")
    median: float = float("nan")


def summarise(values: Sequence[float], *, best: Best = "low") -> Summary:
    """Summarises values; NaN values are left out. `best` says which are good: 'low', 'high', or those near 'zero'."""
    kept = np.array([value for value in values if value == value], dtype=np.float64)
    if not len(kept):
        nan = float("nan")
        return Summary(nan, nan, nan, 0)
    worst = kept[np.abs(kept).argmax()] if best == "zero" else kept.max() if best == "low" else kept.min()
    sd = float(kept.std(ddof=1)) if len(kept) > 1 else float("nan")
    ci95 = float(scipy.stats.t.ppf(0.975, len(kept) - 1)) * sd / sqrt(len(kept)) if len(kept) > 1 else float("nan")
    return Summary(float(kept.mean()), ci95, float(worst), len(kept), sd, float(np.median(kept)))


class ResultRow(NamedTuple):
    """One measure of one method."""

    measure: str
    who: str
    """Our method, or the baseline."""
    values: Summary
    unit: str
    digits: int = 1
    wanted: str = ""
    held: bool | None = None
    paper: str = ""
    """The paper's text about this measure."""
    text: str = ""
    """Text in place of the mean, where a mean is misleading."""

    @property
    def mean(self) -> str:
        if self.text:
            return self.text
        ci95 = self.values.ci95
        return f"{self._number(self.values.mean)}" + ("" if ci95 != ci95 else f" ± {self._number(ci95)}")

    @property
    def worst(self) -> str:
        return self._number(self.values.worst)

    @property
    def verdict(self) -> str:
        return "" if self.held is None else "held" if self.held else "MISSED"

    def data(self) -> dict[str, Any]:
        summary = {key: None if value != value else value for key, value in self.values._asdict().items()}
        return {
            "measure": self.measure, "who": self.who, "unit": self.unit, "said": self.text, **summary,
            "wanted": self.wanted, "held": self.held, "paper": self.paper,
        }  # fmt: skip

    def _number(self, value: float) -> str:
        return "" if value != value else f"{value:.{self.digits}f}"


class Plot(NamedTuple):
    """A plot, and the function that draws it."""

    name: str
    """Name of its file without the suffix."""
    caption: str
    draw: Callable[[], Figure]


@dataclass
class Section:
    key: str
    title: str
    about: str
    """Description of the experiment, a few sentences."""
    rows: list[ResultRow] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    """Runs that failed, each with its error."""

    def data(self) -> dict[str, Any]:
        return {
            "key": self.key, "title": self.title, "about": self.about, "rows": [row.data() for row in self.rows],
            "notes": self.notes, "errors": self.errors,
            "plots": [{"file": f"{plot.name}.png", "caption": plot.caption} for plot in self.plots],
        }  # fmt: skip


def row(measure: str, who: str, values: Sequence[float], unit: str, *, best: Best = "low", **more: Any) -> ResultRow:
    """A row from values, one for each seed or run."""
    return ResultRow(measure, who, summarise(values, best=best), unit, **more)
