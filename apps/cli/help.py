"""`cocoro --help` without the libraries that draw it: they take five times as long to import as Python to start.

`help.page` is that help as they draw it on a terminal where no line is too long; `make manual` writes it. Here its
lines are folded to the terminal's width, as they would have folded them. Where the help may be another one
(unusual settings of the terminal, tasks of third parties), `text` returns None.
"""

from __future__ import annotations

import os
import sys

from cocoro.distributions import may_add_to

PAGE = "help.page"
NARROWEST = 66
"""Columns; below it the libraries also shorten the names of options."""
GROUPS = ("cocoro.tasks", "cocoro.components")
"""Entry points that can add commands."""
SETTINGS = (
    "NO_COLOR", "FORCE_COLOR", "PY_COLORS", "GITHUB_ACTIONS", "TERMINAL_WIDTH", "TTY_COMPATIBLE", "TTY_INTERACTIVE",
    "TYPER_USE_RICH", "_TYPER_FORCE_DISABLE_TERMINAL", "JUPYTER_COLUMNS", "DATABRICKS_RUNTIME_VERSION",
)  # fmt: skip
"""Environment variables by which the libraries draw in another way."""
DUMB = ("dumb", "unknown")
BOLD, DIM = "1", "2"


def text() -> str | None:
    """The help for this terminal; None where the libraries must draw it."""
    width = _width()
    utf8 = (getattr(sys.stdout, "encoding", "") or "").lower().replace("-", "").replace("_", "") == "utf8"
    if width < NARROWEST or not utf8 or os.environ.get("TERM", "").lower() in DUMB:
        return None
    if any(name in os.environ for name in SETTINGS) or any(may_add_to(group) for group in GROUPS):
        return None
    return folded(width, sys.stdout.isatty())


def _width() -> int:
    if (given := os.environ.get("COLUMNS", "")).isdigit():
        return int(given)
    for descriptor in range(3):
        try:
            return os.get_terminal_size(descriptor).columns or 80
        except OSError:
            continue
    return 80


def folded(width: int, colour: bool) -> str:
    """The page at a width of at least `NARROWEST` columns; `colour` with the terminal's styles."""
    lines = []
    with open(os.path.join(os.path.dirname(__file__), PAGE), encoding="utf-8") as page:  # noqa: PTH120, PTH118, PTH123
        for row in page:
            kind, indent, content = row.rstrip("\n").split("\t")
            if kind == "top":
                lines.append(styled([(DIM, f"╭─ {content} {'─' * (width - len(content) - 5)}╮")], colour))
            elif kind == "bottom":
                lines.append(styled([(DIM, f"╰{'─' * (width - 2)}╯")], colour))
            else:
                lines += _row(kind == "row", int(indent), runs(content), width, colour)
    return "\n".join(lines) + "\n"


def _row(boxed: bool, indent: int, runs: list[tuple[str, str]], width: int, colour: bool) -> list[str]:
    """One line of the page, or several: what stands before `indent` stands before the first of them."""
    room = width - indent - (2 if boxed else 1)
    head, body = cut(runs, indent - 2 * boxed)
    drawn = []
    for part in _folds(body, room):
        inside = [*head, *part]
        length = sum(len(words) for _, words in inside)
        padded = [*inside, ("", " " * (width - length - 4 * boxed))]
        if boxed:
            padded = [(DIM, "│"), ("", " "), *padded, ("", " "), (DIM, "│")]
        drawn.append(styled(padded, colour))
        head = [("", " " * (indent - 2 * boxed))]
    return drawn


def _folds(body: list[tuple[str, str]], room: int) -> list[list[tuple[str, str]]]:
    """The lines of a paragraph: each takes as many words as there is room for."""
    plain = "".join(words for _, words in body)
    breaks, used, at = [], 0, 0
    for word in plain.split(" "):
        if used and used + len(word) > room:
            breaks.append(at)
            used = 0
        used += len(word) + 1
        at += len(word) + 1
    parts, done = [], 0
    for end in breaks:
        part, body = cut(body, end - done)
        parts.append(cut(part, end - done - 1)[0])  # without the space that the line ends with
        done = end
    return [*parts, body]


def cut(runs: list[tuple[str, str]], at: int) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    before, after = [], []
    for style, words in runs:
        if words[:at]:
            before.append((style, words[:at]))
        if words[at:]:
            after.append((style, words[at:]))
        at = max(at - len(words), 0)
    return before, after


def runs(styled: str) -> list[tuple[str, str]]:
    """Text with a terminal's codes as pairs of style and text."""
    first, *others = styled.split("\x1b[")
    runs = [("", first)]
    for other in others:
        style, _, words = other.partition("m")
        runs.append(("" if style == "0" else style, words))
    return [(style, words) for style, words in runs if words]


def styled(runs: list[tuple[str, str]], colour: bool) -> str:
    return "".join(f"\x1b[{style}m{words}\x1b[0m" if colour and style else words for style, words in runs)
