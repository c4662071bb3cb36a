"""The page that `apps/cli/help.py` folds, made from what typer and rich draw: `make manual` writes it."""

from __future__ import annotations

import re
from io import StringIO

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
    before = rich_utils.Console
    # Of the terminal that the libraries would find, only these are of interest.
    rich_utils.Console = lambda **options: Console(  # type: ignore[assignment,misc]
        file=out, theme=options["theme"], highlighter=options["highlighter"], width=width, force_terminal=colour,
        color_system="standard" if colour else None, legacy_windows=False, _environ={},
    )  # fmt: skip
    try:
        command = get_command(app)
        with command.make_context("cocoro", [], resilient_parsing=True) as context:
            command.get_help(context)
    finally:
        rich_utils.Console = before  # type: ignore[misc]
    return out.getvalue()


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
