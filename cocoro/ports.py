"""Serial ports by name: a device's path, or `wire:NAME` for an emulated one in the robot's run directory."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from cocoro import private
from cocoro.checks import Check, bad, note, ok
from cocoro.private import default_run_dir

WIRE = "wire:"
LATENCY_MS = 1
"""Wanted latency timer of an FTDI adapter, ms. Its default is 16 ms, and each servo's answer waits for it."""


def wire_dir(robot: str) -> Path:
    """The folder of the simulator's emulated ports."""
    return default_run_dir() / robot / "wire"


def port_path(name: str, robot: str) -> str:
    """The path to open for a port's name. Raises ConfigError for an emulated port whose folder is not this user's
    alone."""
    if not name.startswith(WIRE):
        return name
    folder = wire_dir(robot)
    with suppress(FileNotFoundError), private.directory(folder):
        pass
    return str(folder / name.removeprefix(WIRE))


def check_port(what: str, name: str, robot: str, *, quick: bool) -> list[Check]:
    """Checks that a port exists and may be opened (the first check), and with `quick` the adapter's latency timer."""
    path = port_path(name, robot)
    port = Path(path)
    if not port.exists() and name.startswith(WIRE):
        return [note(f"{what} port", f"{name} is emulated; it exists while the robot is up")]
    if not port.exists():
        return [bad(f"{what} port", f"there is no {path}: plug the adapter in; its name comes from the udev rules")]
    if not os.access(port, os.R_OK | os.W_OK):
        return [bad(f"{what} port", f"{path} may not be used: `sudo usermod -aG dialout $USER`, then log in again")]
    checks = [ok(f"{what} port", path)]
    latency_ms = _latency_ms(port)
    if quick and latency_ms is not None:
        text = f"{latency_ms} ms"
        if latency_ms > LATENCY_MS:
            text += f", should be {LATENCY_MS}: install the udev rules, then plug the adapter in again"
        checks.append((ok if latency_ms <= LATENCY_MS else bad)(f"{what} adapter's latency", text))
    return checks


def _latency_ms(port: Path) -> int | None:
    """The latency timer of an FTDI adapter, ms; None where there is none."""
    with suppress(OSError, ValueError):
        return int(Path(f"/sys/bus/usb-serial/devices/{port.resolve().name}/latency_timer").read_text())
    return None
