"""The captures on this machine: listed, pinned, deleted. All of it works on the disk: call it beside the loop."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from cocoro.capture.folder import IDLE, default_folder, delete, is_pinned, parsed_name, pin_of
from cocoro.capture.listed import ListedCapture, listed_capture
from cocoro.errors import CocoroError, RefusedError

ENDING = ".mcap"


class Rule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which captures are cleaned away: those that fulfil all that is given; pinned ones never."""

    older_than_days: Annotated[float, Meta(ge=0)] | None = None
    idle: bool = False
    """Only those in which nothing happened."""

    def __post_init__(self) -> None:
        if self.older_than_days is None and not self.idle:
            raise ValueError("give older_than_days, or idle = true, or both")


class NoCaptureError(CocoroError):
    """There is no capture of that name."""


class Shelf:
    """The captures in the folders of this machine, by the names of their files without the ending."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = default_folder() if folder is None else folder
        self._known: dict[Path, tuple[tuple[int, int], ListedCapture]] = {}

    def listed(self, written: Iterable[str]) -> list[dict[str, Any]]:
        """All captures, the newest first; `written`: the files that recorders say they write."""
        written = set(written)
        found = sorted(self._paths(written), key=_began, reverse=True)
        self._known = {path: known for path, known in self._known.items() if path in set(found)}
        return [self._row(path, str(path) in written) for path in found]

    def find(self, name: str, written: Iterable[str] = ()) -> Path:
        """The file of a name. Raises NoCaptureError."""
        for path in self._paths(written):
            if path.name.removesuffix(ENDING) == name:
                return path
        raise NoCaptureError(f"there is no capture {name!r} here: it may have made room for others")

    def pin(self, name: str, on: bool, written: Iterable[str] = ()) -> None:
        """Keep a capture, or let it go. Raises NoCaptureError, RefusedError."""
        pinned = pin_of(self.find(name, written))
        try:
            if on:
                pinned.touch()
            else:
                pinned.unlink(missing_ok=True)
        except OSError as error:
            raise RefusedError(f"{pinned} cannot be written: {error.strerror}") from error

    def remove(self, name: str, written: Iterable[str]) -> None:
        """Delete a capture. Raises NoCaptureError, and RefusedError for one that is pinned or being written."""
        written = set(written)
        path = self.find(name, written)
        if is_pinned(path):
            raise RefusedError(f"{name} is pinned: unpin it first")
        if str(path) in written:
            raise RefusedError(f"{name} is being written: it can be deleted when the next one has begun")
        try:
            delete(path)
        except OSError as error:
            raise RefusedError(f"{name} cannot be deleted: {error.strerror}") from error

    def clean(self, rule: Rule, written: Iterable[str], now: datetime | None = None) -> list[str]:
        """Delete what the rule is for; returns the names. Pinned captures and those that are being written stay."""
        written = set(written)
        before = None
        if rule.older_than_days is not None:
            before = (now or datetime.now(UTC)) - timedelta(days=rule.older_than_days)
        gone = []
        for path in list(self._paths(written)):
            name = parsed_name(path)
            if name is None or is_pinned(path) or str(path) in written:
                continue
            if rule.idle and name.label != IDLE:
                continue
            with suppress(OSError):
                if before is None or path.stat().st_mtime < before.timestamp():
                    delete(path)
                    gone.append(path.name.removesuffix(ENDING))
        return sorted(gone)

    def _paths(self, written: Iterable[str]) -> Iterator[Path]:
        folders = [self._folder, *(Path(file).parent for file in written if file)]
        for folder in dict.fromkeys(folders):
            with suppress(OSError):
                yield from (path for path in folder.glob(f"*{ENDING}") if parsed_name(path) is not None)

    def _row(self, path: Path, written: bool) -> dict[str, Any]:
        name = path.name.removesuffix(ENDING)
        with suppress(OSError):
            status = path.stat()
            state = status.st_size, status.st_mtime_ns
            known = self._known.get(path)
            if known is None or known[0] != state:
                parsed = parsed_name(path)
                assert parsed is not None
                known = state, listed_capture(name, path, parsed)
                self._known[path] = known
            row: dict[str, Any] = msgspec.to_builtins(known[1])
            row["pinned"] = is_pinned(path)
            del row["file"]
            return row | {"written": written}
        return {"name": name, "gone": True}


def _began(path: Path) -> tuple[str, int]:
    parsed = parsed_name(path)
    assert parsed is not None
    return parsed.run.rpartition("-")[2], parsed.number
