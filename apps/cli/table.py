"""A plain table: columns that line up, no frames, as wide as it needs to be, so that other tools can read it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    cells = [tuple(head.upper() for head in heads), *rows]
    widths = [max(len(row[column]) for row in cells) for column in range(len(heads))]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells)
    return "".join(f"{line}\n" for line in lines)


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    print(table(heads, rows), end="")
