"""Runs a notebook's cells, one after the other, as a program: `python tests/notebook_rig.py NOTEBOOK`.

The usual way, nbclient with ipykernel, brings 31 packages (15 MB packed) and a kernel with five sockets, for what is
`exec` here: the cells of a notebook of ours are plain Python. Prints one JSON object for each cell: what it printed,
and its last value as text.
"""

from __future__ import annotations

import ast
import contextlib
import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def cells(notebook: Path, kind: str = "code") -> list[str]:
    """The texts of the cells of a kind, in order."""
    found = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == kind]


def shown(source: str, names: dict[str, Any]) -> tuple[str, object]:
    """Runs one cell; returns what it printed, and the value of its last expression. A semicolon at its end hides it."""
    body = ast.parse(source).body
    last = body.pop() if body and isinstance(body[-1], ast.Expr) else None
    printed = io.StringIO()
    value = None
    with contextlib.redirect_stdout(printed):
        exec(compile(ast.Module(body, []), "<cell>", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), names)
    return printed.getvalue(), None if source.rstrip().endswith(";") else value


def run(notebook: Path) -> Iterator[dict[str, str]]:
    """Runs all code cells in one namespace."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for source in cells(notebook):
        printed, value = shown(source, names)
        picture = getattr(value, "_repr_png_", None)
        yield {
            "printed": printed,
            "value": "" if value is None else repr(value),
            "picture": "" if picture is None else picture()[:8].hex(),
        }


if __name__ == "__main__":
    for result in run(Path(sys.argv[1])):
        print(json.dumps(result), flush=True)
