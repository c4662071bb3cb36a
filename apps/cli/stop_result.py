"""What became of a stop: of one robot, for people and for the exit code."""

from __future__ import annotations

from typing import NamedTuple

from apps.cli import exits
from cocoro.stop.asking import STOPPABLE


class StopResult(NamedTuple):
    """Result of stopping one robot."""

    robot: str
    acknowledged: tuple[str, ...]
    missing: tuple[str, ...]
    """Services that run and did not acknowledge."""
    absent: tuple[str, ...]
    """Services that do not run."""
    seconds: float
    """Time from Enter until the last service had stopped what it moves."""
    not_kept: tuple[str, ...] = ()
    """Reasons why latches will not survive a restart."""
    not_yet_kept: tuple[str, ...] = ()
    """Services that have not reported whether their latch is on the disk."""
    owner: int | None = None
    """User id of the owner when it is another user's robot."""
    latched_ns: dict[str, int] = {}  # noqa: RUF012 # read only
    """Time at which each service stopped what it moves, ns of CLOCK_MONOTONIC; known by the stop path only."""

    @property
    def code(self) -> int:
        if self.missing:
            return exits.FAILED
        return exits.DONE if any(service in STOPPABLE for service in self.acknowledged) else exits.NO_MESH

    def __str__(self) -> str:
        whose = "" if self.owner is None else f" (of user {self.owner})"
        text = f"{self.robot}{whose}: stopped {', '.join(self.acknowledged) or 'nothing'} in {self.seconds:.2f} s"
        if self.missing:
            text += f"; NOT ACKNOWLEDGED by {', '.join(self.missing)}"
        if self.absent:
            text += f"; not there: {', '.join(self.absent)}"
        if self.not_kept:
            text += f"; A RESTART WILL FORGET IT: {', '.join(self.not_kept)}"
        if self.not_yet_kept:
            text += f"; not yet known to be on the disk: {', '.join(self.not_yet_kept)}"
        return text
