"""The public names of `cocoro`, by `__all__`."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import cocoro

IMPORTS = [
    node
    for node in ast.parse(Path(cocoro.__file__).with_name("api.py").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
]


def test_every_public_name_is_found_in_the_module_that_defines_it() -> None:
    for name in cocoro.__all__:
        assert getattr(cocoro, name) is not None
    assert cocoro.Node.__module__ == "cocoro.node"
    assert cocoro.Component.__module__ == "cocoro.component"


def test_type_checkers_see_the_same_names_from_the_same_modules() -> None:
    for node in IMPORTS:
        for alias in node.names:
            assert alias.asname == alias.name  # this form exports it, to strict type checkers too
            assert getattr(sys.modules[str(node.module)], alias.name) is getattr(cocoro, alias.name)
    assert sorted(alias.name for node in IMPORTS for alias in node.names) == sorted(cocoro.__all__)


def test_the_docstring_names_every_public_name() -> None:
    assert cocoro.__doc__ is not None
    kinds = {name for name in cocoro.__all__ if name.endswith(("Clock", "Error"))}  # the docstring names their kind
    assert [name for name in cocoro.__all__ if f"`{name}`" not in cocoro.__doc__ and name not in kinds] == []


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        cocoro.Nothing  # type: ignore[attr-defined] # noqa: B018


def test_type_checkers_see_the_names_that_applications_lend_as_they_are_found() -> None:
    stub = ast.parse(Path(cocoro.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    seen = {
        alias.name: node.module
        for node in ast.walk(stub)
        if isinstance(node, ast.ImportFrom) and node.module != "cocoro.api"
        for alias in node.names
    }
    assert seen == cocoro._LENT  # type: ignore[attr-defined] # what the stub does not have
    for name, module in seen.items():
        assert callable(getattr(cocoro, name))
        assert getattr(cocoro, name).__module__ == module
        assert name in dir(cocoro)
        assert name not in cocoro.__all__


@pytest.mark.process
@pytest.mark.parametrize(
    ("statement", "loaded"), [("import cocoro", []), ("from cocoro import errors", ["cocoro.errors"])]
)
def test_importing_the_package_or_one_module_loads_no_other_module(statement: str, loaded: list[str]) -> None:
    code = f"import sys; {statement}; print(*[name for name in sys.modules if name.startswith('cocoro.')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == loaded
