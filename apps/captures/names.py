"""Names of the captures on this machine, by the names of their files. Imports little: a shell completes by it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from cocoro.capture.folder import IDLE, default_folder, parsed_name
from cocoro.errors import CocoroError
from deploy.rundir import RunDir, robots

LATEST = "latest"


def folders() -> list[Path]:
    """The folders into which this user's recorders write: the default one, and those of robots that are up here."""
    found = [default_folder()]
    with suppress(CocoroError, OSError):
        for run_dir in robots():
            settings = run_dir.resolved().get("service", {}).get("capture", {})
            if isinstance(own := settings.get("folder"), str):
                found.append(Path(own))
    return list(dict.fromkeys(found))


def open_captures(run_dir: RunDir) -> list[Path]:
    """The captures that a robot's recorder on this machine has open now."""
    found = []
    with suppress(OSError, CocoroError):
        pid = run_dir.claimant_pid("capture")
        for link in Path(f"/proc/{pid}/fd").iterdir() if pid else ():
            with suppress(OSError):
                path = link.readlink()
                if path.suffix == ".mcap" and path.exists():
                    found.append(path)
    return list(dict.fromkeys(found))  # it may have one open twice


def shelf(robot: str | None = None) -> list[tuple[str, Path]]:
    """Name and path of each capture, the newest first; of one robot, or of all."""
    found = []
    for folder in folders():
        for path in folder.glob("*.mcap"):
            name = parsed_name(path)
            if name is not None and robot in (None, name.robot):
                with suppress(OSError):
                    found.append((path.stat().st_mtime_ns, name.number, name.label != IDLE, path))
    return _named([(eventful, path) for _, _, eventful, path in sorted(found, reverse=True)])


def _named(newest_first: Sequence[tuple[bool, Path]]) -> list[tuple[str, Path]]:
    """`idle` counts those in which nothing happened, `latest` the others."""
    counts = {True: 0, False: 0}
    named = []
    for eventful, path in newest_first:
        name, back = LATEST if eventful else IDLE, counts[eventful]
        named.append((f"{name}-{back}" if back else name, path))
        counts[eventful] += 1
    return named
