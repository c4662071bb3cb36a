"""`--csv` and `--parquet`: each key as a table, and a table of belief and truth."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

from apps.captures.export.story import beliefs
from cocoro.capture.conventions import CaptureError
from cocoro.capture.mcap import DamageError
from cocoro.capture.reader import Capture
from cocoro.clock import NS

LONGEST_LIST = 16
"""A longer list of plain values is replaced by its length."""

TableRow = dict[str, Any]


class TableFolder(Protocol):
    """Writes tables to a folder."""

    def write(self, name: str, rows: list[TableRow]) -> None: ...


def export(capture: Capture, folder: TableFolder) -> list[str]:
    """Write a table for each key whose messages are maps (one per channel where it has several), one for each list of
    maps in them, and `belief` when the simulator's truth is recorded.

    Returns the tables' names. Raises CaptureError when one cannot be written.
    """
    written = []
    for channel in (id for _, ids in sorted(capture.keys.items()) for id in ids):
        key = capture.channels[channel].topic
        number = f"#{channel}" if len(capture.keys[key]) > 1 else ""
        tables = _tables(capture, channel)
        for part, rows in tables.items():
            head = key.removeprefix(f"{capture.robot}/").strip("/").replace("/", "_")
            name = ".".join(filter(None, (f"{head}{number}", part)))
            folder.write(name, rows)
            written.append(name)
    aligned = list(beliefs(capture))
    if aligned:
        folder.write("belief", aligned)
        written.append("belief")
    return written


def _tables(capture: Capture, channel: int) -> dict[str, list[TableRow]]:
    """Tables by the name of the list that they hold; '' for the key's own."""
    tables: dict[str, list[TableRow]] = {}
    for record in capture.messages(channels=[channel]):
        try:
            message = capture.decode(record)
        except DamageError:
            continue
        if not isinstance(message, Mapping):
            continue
        head: TableRow = {
            "time_s": (record.log_ns - capture.start_ns) / NS,
            "log_ns": record.log_ns,
            "stamp_ns": record.publish_ns,
            "seq": record.sequence,
        }
        row = dict(head)
        for name, value in message.items():
            if name in head:
                continue
            if isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
                row[f"{name}.count"] = len(value)
                parts = tables.setdefault(str(name), [])
                parts += [{**head, "index": n, **_flat(item)} for n, item in enumerate(value)]
            else:
                row.update(_flat({name: value}))
        tables.setdefault("", []).append(row)
    return tables


def _flat(value: Any, name: str = "") -> TableRow:
    """Maps and short lists as columns, such as 'odometry_m.0'."""
    if isinstance(value, Mapping):
        return _joined(((str(part), item) for part, item in value.items()), name)
    if isinstance(value, list):
        if len(value) > LONGEST_LIST or any(isinstance(item, Mapping) for item in value):
            return {f"{name}.count": len(value)}
        return _joined(((str(n), item) for n, item in enumerate(value)), name)
    if isinstance(value, bytes):
        return {f"{name}.bytes": len(value)}
    return {name: value}


def _joined(parts: Iterator[tuple[str, Any]], name: str) -> TableRow:
    found: TableRow = {}
    for part, item in parts:
        found.update(_flat(item, f"{name}.{part}" if name else part))
    return found


def columns(rows: list[TableRow]) -> list[str]:
    """All columns of the rows, in the order of appearance. A field that is a map or a list, or None ('target' beside
    'target.label'), has only the columns of its parts."""
    names = dict.fromkeys(name for row in rows for name in row)
    wholes = {name[:at] for name in names for at, letter in enumerate(name) if letter == "."}
    return [name for name in names if name not in wholes or any(row.get(name) is not None for row in rows)]


class CsvFolder:
    """One CSV file per table."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def write(self, name: str, rows: list[TableRow]) -> None:
        path = self._folder / f"{name}.csv"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with path.open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, columns(rows), restval="", extrasaction="ignore")
                writer.writeheader()
                writer.writerows(rows)
        except OSError as error:
            raise CaptureError(f"{path}: {error.strerror}") from error


class ParquetFolder:
    """One Parquet file per table. Raises CaptureError when pyarrow is not installed."""

    def __init__(self, folder: Path) -> None:
        try:
            import pyarrow
            import pyarrow.parquet
        except ModuleNotFoundError as error:
            raise CaptureError(
                "--parquet needs pyarrow: pip install 'cocoro-mesh[tables]'; --csv needs nothing"
            ) from error
        self._arrow = pyarrow
        self._folder = folder

    def write(self, name: str, rows: list[TableRow]) -> None:
        path = self._folder / f"{name}.parquet"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            table = self._arrow.table({column: self._column(rows, column) for column in columns(rows)})
            self._arrow.parquet.write_table(table, path)
        except OSError as error:
            raise CaptureError(f"{path}: {error.strerror or error}") from error

    def _column(self, rows: list[TableRow], name: str) -> Any:
        values = [row.get(name) for row in rows]
        try:
            return self._arrow.array(values)
        except (self._arrow.ArrowInvalid, self._arrow.ArrowTypeError):  # values of several types: as text
            return self._arrow.array([None if value is None else str(value) for value in values])
