"""Which robot a command is for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RobotChoice:
    """The robot that a command is for, from `--robot` and `--profile`; neither is needed when one robot is up here."""

    robot: str | None = None
    profile: str | None = None
    """Reach it through the mesh of this profile, on another machine."""
