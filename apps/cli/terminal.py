"""Tables and a status line on the operator's terminal; plain text of full width where the output is no terminal.

A table fits itself to the terminal: optional columns are left out, the last ones first, then what still does not fit
goes into a second line of its row.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from io import StringIO
from types import TracebackType
from typing import TYPE_CHECKING, NamedTuple, TextIO

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.live import Live
    from rich.text import Text

PLAIN_WIDTH = 10_000
"""Columns of a table that is written into a file or a pipe: enough that nothing is folded or cut."""
GAP, SHIFT = 2, 4
"""Spaces between two columns, and before the second line of a row."""
TEXT_WIDTH = 24
"""A column of sentences that would be narrower than this goes into the second line."""


class Column(NamedTuple):
    """The form of a table's column."""

    head: str
    rank: int = 0
    """0: the column is always shown. Of the others empty ones are left out first, then those with the highest rank."""
    right: bool = False
    text: bool = False
    """Sentences: folded to the width that the other columns leave. At most one column of a table, the last."""


def print_table(columns: Sequence[str | Column], rows: Iterable[Sequence[str]]) -> None:
    """Prints a table on standard output, as wide as the terminal at most."""
    print(table(columns, rows), end="")


def table(columns: Sequence[str | Column], rows: Iterable[Sequence[str]], width: int | None = None) -> str:
    """Returns a table as text: aligned columns, capital headers, no frame, no spaces at the ends of lines.

    `width` is that of standard output's terminal by default, unlimited where it is none.
    """
    if width is None:
        width = output_width()
    rows = [tuple(row) for row in rows]
    if (plain := _plain_table(_columns(columns), rows, width)) is not None:
        return plain
    from rich.console import Console

    out = StringIO()
    Console(file=out, width=width, force_terminal=False, color_system=None).print(FittedTable(columns, rows))
    return "".join(f"{line.rstrip()}\n" for line in out.getvalue().splitlines())


def _columns(columns: Sequence[str | Column]) -> list[Column]:
    return [Column(column) if isinstance(column, str) else column for column in columns]


def _plain_table(columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int) -> str | None:
    """The table, without the library that draws it, where nothing is to be fitted: it is not wider than `width`, and
    each character of its cells takes one column."""
    lines = [tuple(column.head.upper() for column in columns), *rows]
    if not all(cell.isascii() and cell.isprintable() for line in lines for cell in line):
        return None
    widths = [max(len(line[number]) for line in lines) for number in range(len(columns))]
    if sum(widths) + GAP * (len(widths) - 1) > width:
        return None
    return "".join(
        (" " * GAP)
        .join(
            cell.rjust(room) if column.right else cell.ljust(room)
            for cell, room, column in zip(line, widths, columns, strict=True)
        )
        .rstrip()
        + "\n"
        for line in lines
    )


def fields(pairs: Iterable[tuple[str, str]]) -> str:
    """Returns lines `name  value` as text, the values below one another and folded to the terminal's width."""
    found = [(name, value) for name, value in pairs if value]
    indent = max((len(name) for name, _ in found), default=0) + GAP
    return "".join(f"{line}\n" for name, value in found for line in folded(f"{name:<{indent}}", value))


def folded(head: str, text: str, width: int | None = None) -> list[str]:
    """The lines of `head` and `text`, folded to the terminal's width below the text's beginning."""
    room = max((output_width() if width is None else width) - len(head), 10)
    if len(text) <= room:
        return [head + text]
    from textwrap import wrap

    first, *rest = wrap(text, room, break_on_hyphens=False) or [text]
    return [head + first, *(" " * len(head) + line for line in rest)]


def output_width() -> int:
    """Columns of the terminal that is standard output; PLAIN_WIDTH when it is none."""
    if not sys.stdout.isatty():
        return PLAIN_WIDTH
    import shutil  # slow to import

    return shutil.get_terminal_size().columns


class FittedTable:
    """A table for rich's consoles that fits itself to the width that it is drawn with."""

    def __init__(
        self, columns: Sequence[str | Column], rows: Iterable[Sequence[str | Text]], *, fold: bool = True
    ) -> None:
        """`fold`: sentences that are too long go on in further lines; otherwise they are cut."""
        from rich.text import Text

        self._fold = fold
        self._columns = _columns(columns)
        self._rows = [[cell if isinstance(cell, Text) else Text(cell) for cell in row] for row in rows]
        self._natural = [
            max(len(column.head), *(row[number].cell_len for row in self._rows)) if self._rows else len(column.head)
            for number, column in enumerate(self._columns)
        ]

    def __rich_console__(self, _console: Console, options: ConsoleOptions) -> Iterator[Text]:
        from rich.text import Text

        shown, below = self._fitted(options.max_width)
        widths = self._widths(shown, options.max_width)
        yield self._line([Text(self._columns[number].head.upper(), "dim") for number in shown], shown, widths)
        for row in self._rows:
            cells = [list(self._folded(row[number], widths[number])) for number in shown]
            for at in range(max(map(len, cells), default=0)):
                yield self._line([cell[at] if at < len(cell) else Text() for cell in cells], shown, widths)
            for line in () if not self._fold else self._second(row, below, options.max_width - SHIFT):
                yield Text(" " * SHIFT).append_text(line)
        away = {*range(len(self._columns))} - {*shown, *below}
        if left_out := [self._columns[number].head for number in sorted(away) if self._is_filled(number)]:
            yield Text(
                f"(a wider terminal shows, too: {', '.join(left_out)})", "dim", no_wrap=True, overflow="ellipsis"
            )

    def _fitted(self, width: int) -> tuple[list[int], list[int]]:
        """The columns of a row's first line and of its second, by their numbers."""
        shown, below = list(range(len(self._columns))), list[int]()
        while self._needed(shown) > width and (optional := [n for n in shown if self._columns[n].rank]):
            shown.remove(max(optional, key=lambda n: (not self._is_filled(n), self._columns[n].rank, n)))
        while self._needed(shown) > width and len(shown) > 1:
            below.insert(0, shown.pop())
        return shown, below

    def _is_filled(self, number: int) -> bool:
        return any(row[number].plain.strip() for row in self._rows)

    def _needed(self, shown: list[int]) -> int:
        least = [min(self._natural[n], TEXT_WIDTH) if self._columns[n].text else self._natural[n] for n in shown]
        return sum(least) + GAP * (len(shown) - 1)

    def _widths(self, shown: list[int], width: int) -> dict[int, int]:
        widths = {number: min(self._natural[number], width) for number in shown}
        for number in shown:
            if self._columns[number].text:
                others = sum(widths[other] + GAP for other in shown if other != number)
                widths[number] = max(1, min(widths[number], width - others))
        return widths

    def _line(self, cells: list[Text], shown: list[int], widths: dict[int, int]) -> Text:
        from rich.text import Text

        line = Text(no_wrap=True, overflow="ellipsis")
        for place, (cell, number) in enumerate(zip(cells, shown, strict=True)):
            space = " " * (widths[number] - cell.cell_len)
            line.append(" " * GAP if place else "")
            line.append(space if self._columns[number].right else "").append_text(cell)
            line.append("" if self._columns[number].right or place == len(shown) - 1 else space)
        return line

    def _folded(self, cell: Text, width: int) -> Iterator[Text]:
        if not self._fold:
            cell = cell.copy()
            cell.truncate(width, overflow="ellipsis")
        if cell.cell_len <= width:
            yield cell
            return
        from rich.console import Console

        yield from (_stripped(line) for line in cell.wrap(Console(width=width, file=StringIO()), width))

    def _second(self, row: list[Text], below: list[int], width: int) -> Iterator[Text]:
        """The lines of what does not fit beside the other columns, each value after its column's name."""
        from rich.text import Text

        line = Text()
        for number in below:
            if not row[number].plain.strip():
                continue
            column = self._columns[number]
            line.append(", " if line.plain else "").append("" if column.text else f"{column.head} ", "dim")
            line.append_text(row[number])
        if line.plain:
            yield from self._folded(line, width)


def _stripped(line: Text) -> Text:
    line.rstrip()
    return line


class StatusLine:
    """One line at the bottom of a terminal that is rewritten in place; other text goes above it.

    Where `out` (standard output by default) is no terminal, `show` does nothing. A context manager: leaving it erases
    the line.
    """

    def __init__(self, out: TextIO | None = None) -> None:
        self._out = sys.stdout if out is None else out
        self._live: Live | None = None

    def __enter__(self) -> StatusLine:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def shown(self) -> bool:
        """Whether the line can be seen, so that `show` is worth its call."""
        return self._out.isatty()

    def show(self, text: str) -> None:
        """Puts `text` on the line; what does not fit into the terminal's width is cut."""
        if self.shown:
            from rich.text import Text

            self._started().update(Text(text, no_wrap=True, overflow="ellipsis"), refresh=True)

    def print(self, text: str, file: TextIO | None = None) -> None:
        """Prints `text` above the line, on `file` or on the line's own output."""
        if self._live is not None:
            self._live.update("", refresh=True)
        print(text, file=file or self._out, flush=True)

    def close(self) -> None:
        """Erases the line; a later `show` brings it back."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _started(self) -> Live:
        if self._live is None:
            from rich.console import Console
            from rich.live import Live

            console = Console(file=self._out)
            self._live = Live(
                console=console, auto_refresh=False, transient=True, redirect_stdout=False, redirect_stderr=False
            )
            self._live.start()
        return self._live
