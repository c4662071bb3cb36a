"""Progress of a rehearsal."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class RehearsalProgress(NamedTuple):
    """The state of a running rehearsal, as its display shows it."""

    phase: str
    sim_s: float
    """Simulated time since the task began."""
    share: float | None = None
    """Done part of the task, 0 to 1; None where nobody can know it."""
    said: str = ""
    """The progress in words, where the task has some."""

    def __str__(self) -> str:
        share = "" if self.share is None else f"{self.share:.0%} "
        return f"{share}{self.said or f'{self.phase}, {self.sim_s:.0f} simulated s'}"


Tell = Callable[[RehearsalProgress], None]


def ignored(_progress: RehearsalProgress) -> None:
    """Shows nothing."""
