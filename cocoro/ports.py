"""Serial ports by name: a device's path, or `wire:NAME` for an emulated one in the robot's run directory."""

from __future__ import annotations

from pathlib import Path

from cocoro.rundir import RunDir

WIRE = "wire:"


def wire_dir(robot: str) -> Path:
    """Where the simulator puts its emulated ports."""
    return RunDir(robot).path / "wire"


def port_path(name: str, robot: str) -> str:
    """The path to open."""
    return str(wire_dir(robot) / name.removeprefix(WIRE)) if name.startswith(WIRE) else name
