"""Which robot a command is for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RobotChoice:
    """The robot that a command is for, from `--robot` and `--site`; neither is needed when one robot is up here."""

    robot: str | None = None
    site: str | None = None
    """Reach it on other machines, through a site: `NAME@DIR` or `DIR`."""
