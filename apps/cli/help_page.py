"""The page that `apps/cli/help.py` folds, made from what typer and rich draw: `make manual` writes it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from io import StringIO
from typing import Any

from rich.console import Console
from typer import rich_utils
from typer.main import get_command

from apps.cli import help
from apps.cli.app import app

WIDE = 1000
"""Columns; nothing is folded at it."""
CODE = re.compile(r"\x1b\[[0-9;]*m")


def drawn(width: int, colour: bool) -> str:
    """The help as the libraries draw it."""
    out = StringIO()
    # Of the terminal that the libraries would find, only these are of interest.
    console = partial(
        Console, file=out, width=width, force_terminal=colour, color_system="standard" if colour else None,
        legacy_windows=False, _environ={},
    )  # fmt: skip
    command = get_command(app)
    with _console_of_typer(console), command.make_context("cocoro", [], resilient_parsing=True) as context:
        command.get_help(context)
    return out.getvalue()


@contextmanager
def _console_of_typer(console: Callable[..., Console]) -> Iterator[None]:
    """Has typer draw on this console."""

    def made(*, theme: Any, highlighter: Any, **_: Any) -> Console:
        return console(theme=theme, highlighter=highlighter)

    typer_s: Any = rich_utils
    before = typer_s.Console
    typer_s.Console = made
    try:
        yield
    finally:
        typer_s.Console = before


def page() -> str:
    return "".join(f"{row}\n" for row in map(_row, drawn(WIDE, True).splitlines()))


def _row(line: str) -> str:
    plain = CODE.sub("", line)
    if plain.startswith("╭"):
        return f"top\t0\t{plain.strip('╭─╮ ')}"
    if plain.startswith("╰"):
        return "bottom\t0\t"
    if not plain.startswith("│"):
        return f"text\t1\t{_until(line, len(plain.rstrip()))}"
    inside = plain.strip("│").rstrip()
    column = max(found.end() for found in re.finditer(r" {2,}", inside[:60]))  # where what the others fill ends
    return f"row\t{column + 1}\t{_until(line.partition('│')[2].partition(' ')[2], len(inside) - 1)}"


def _until(line: str, length: int) -> str:
    """The first characters of a styled text, with its styles."""
    return help.styled(help.cut(help.runs(line), length)[0], True)


if __name__ == "__main__":
    print(page(), end="")
