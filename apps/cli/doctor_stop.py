"""Checks of `cocoro doctor` on the emergency stop: whether the stop path works, and where the latch is kept."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from apps.cli.stop_asking import addresses
from cocoro.checks import Check, bad, note, ok
from cocoro.stop.path import StopPoint
from cocoro.stop.record import latch_dir, read

IN_MEMORY = ("tmpfs", "ramfs")


def check(robot: str) -> Iterator[Check]:
    yield _path()
    yield _latch(robot)


def _path() -> Check:
    """Opens a stop point as a service does, and looks for it as `cocoro stop` does."""
    name = f"doctor-{os.getpid()}"
    try:
        with closing(StopPoint(name, "doctor")):
            found = addresses(name)
    except OSError as error:
        return bad("emergency stop", f"the stop path does not work ({error}): is /proc mounted?")
    if not found:
        return bad(
            "emergency stop", "its addresses are missing in /proc/net/unix, so `cocoro stop` would not find them"
        )
    return ok("emergency stop", "the stop path works; every user of this machine may stop the robot")


def _latch(robot: str) -> Check:
    folder = latch_dir(robot)
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        return bad(
            "its latch",
            f"{there} cannot be written, so the robot starts stopped; set COCORO_STATE_DIR",
        )
    if (kind := _filesystem(there)) in IN_MEMORY:
        return bad(
            "its latch",
            f"{folder} is in memory ({kind}) and does not survive a reboot; set COCORO_STATE_DIR",
        )
    latched = (
        [latch for file in sorted(folder.glob("[!.]*")) if (latch := read(file)).latched] if folder.is_dir() else []
    )
    if latched:
        return note("its latch", f"latched by {latched[0].by}; `cocoro reset` releases it when the robot is up")
    return ok("its latch", f"kept in {folder}")


def _filesystem(path: Path) -> str:
    """Type of the file system that holds a path; empty where /proc does not list it."""
    try:
        mounts = [line.split() for line in Path("/proc/self/mounts").read_text(errors="replace").splitlines()]
    except OSError:
        return ""
    place = str(path.resolve())
    over = [(row[1], row[2]) for row in mounts if place == row[1] or place.startswith(row[1].rstrip("/") + "/")]
    return max(over, key=lambda row: len(row[0]), default=("", ""))[1]
