"""What an experiment has to say: rows of a table, plots, words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from apps.experiments.stats import Best, Summary, summarise

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ResultRow(NamedTuple):
    """One measure of one way of doing it."""

    measure: str
    who: str
    """Ours, or which baseline."""
    values: Summary
    unit: str
    digits: int = 1
    wanted: str = ""
    held: bool | None = None
    paper: str = ""
    """What the paper's text says of the same."""
    said: str = ""
    """Instead of the mean, where a mean says little."""

    @property
    def mean(self) -> str:
        if self.said:
            return self.said
        ci95 = self.values.ci95
        return f"{self._text(self.values.mean)}" + ("" if ci95 != ci95 else f" ± {self._text(ci95)}")

    @property
    def worst(self) -> str:
        return self._text(self.values.worst)

    @property
    def verdict(self) -> str:
        return "" if self.held is None else "held" if self.held else "MISSED"

    def data(self) -> dict[str, Any]:
        summary = {key: None if value != value else value for key, value in self.values._asdict().items()}
        return {
            "measure": self.measure, "who": self.who, "unit": self.unit, "said": self.said, **summary,
            "wanted": self.wanted, "held": self.held, "paper": self.paper,
        }  # fmt: skip

    def _text(self, value: float) -> str:
        return "" if value != value else f"{value:.{self.digits}f}"


class Plot(NamedTuple):
    """A picture, drawn when it is wanted."""

    name: str
    """Of its file, without the ending."""
    caption: str
    draw: Callable[[], Figure]


@dataclass
class Section:
    key: str
    title: str
    about: str
    """What was done, in a few sentences."""
    rows: list[ResultRow] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    """Runs that could not be."""

    def data(self) -> dict[str, Any]:
        return {
            "key": self.key, "title": self.title, "about": self.about, "rows": [row.data() for row in self.rows],
            "notes": self.notes, "errors": self.errors,
            "plots": [{"file": f"{plot.name}.png", "caption": plot.caption} for plot in self.plots],
        }  # fmt: skip


def row(measure: str, who: str, values: Sequence[float], unit: str, *, best: Best = "low", **more: Any) -> ResultRow:
    """A row over values, one a seed or a run."""
    return ResultRow(measure, who, summarise(values, best=best), unit, **more)
