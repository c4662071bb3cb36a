"""Import cycles: no two modules import each other, directly or over others. Imports for types alone and within
functions count, and no import is hidden from these tests and from the linter."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("apps", "cocoro", "deploy", "services", "sim")


def modules() -> dict[str, Path]:
    """The files of all modules by dotted name; a package is its `__init__`."""
    files = (file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
    names = {".".join(file.relative_to(ROOT).with_suffix("").parts): file for file in files}
    return {name.removesuffix(".__init__"): file for name, file in names.items()}


def imports(file: Path, known: dict[str, Path]) -> set[str]:
    """The modules of `known` that a file imports anywhere in its text."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            assert node.level == 0, f"{file}: a relative import"
            names = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            found |= {full if full in known else node.module for full in names.values()}
    return found & known.keys()


def cycle(graph: dict[str, set[str]]) -> list[str]:
    """The modules of one cycle, the first one again at the end; empty when there is none."""
    done: set[str] = set()
    path: list[str] = []

    def visit(name: str) -> Iterator[list[str]]:
        if name in path:
            yield [*path[path.index(name) :], name]
        elif name not in done:
            path.append(name)
            for imported in sorted(graph[name]):
                yield from visit(imported)
            path.pop()
            done.add(name)

    return next((found for name in sorted(graph) for found in visit(name)), [])


def test_a_cycle_is_found_whatever_its_length() -> None:
    assert cycle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    assert cycle({"a": {"a"}}) == ["a", "a"]
    assert cycle({"a": {"b"}, "b": {"c"}, "c": {"d"}, "d": {"b"}}) == ["b", "c", "d", "b"]


def test_no_module_imports_itself_over_others() -> None:
    known = modules()
    assert {"cocoro.node", "services.planning.core", "apps.cli.main"} <= known.keys()
    assert " -> ".join(cycle({name: imports(file, known) for name, file in known.items()})) == ""


def test_modules_are_loaded_by_name_in_two_files_only() -> None:
    by_name = re.compile(r"\b(import_module|__import__|run_module|entry_points)\(")
    found = {name for name, file in modules().items() if by_name.search(file.read_text(encoding="utf-8"))}
    assert found == {"cocoro.component", "cocoro.entry_points"}
