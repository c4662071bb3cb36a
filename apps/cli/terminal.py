"""Tables and a status line on the operator's terminal, drawn by rich; plain text where the output is no terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from io import StringIO
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.live import Live
    from rich.table import Table

PLAIN_WIDTH = 10_000
"""Columns of a table that is written into a file or a pipe: enough that nothing is folded or cut."""


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Prints a table on standard output; a terminal that is too narrow folds its cells."""
    if not sys.stdout.isatty():
        print(table(heads, rows), end="")
        return
    from rich.console import Console

    Console(highlight=False).print(_table(heads, rows))


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a table as text: aligned columns, capital headers, no frame, no spaces at the ends of lines."""
    from rich.console import Console

    out = StringIO()
    Console(file=out, width=PLAIN_WIDTH, force_terminal=False, color_system=None).print(_table(heads, rows))
    return "".join(f"{line.rstrip()}\n" for line in out.getvalue().splitlines())


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    from rich.table import Table
    from rich.text import Text

    made = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    for head in heads:
        made.add_column(Text(head.upper()), overflow="fold")
    for row in rows:
        made.add_row(*map(Text, row))
    return made


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
