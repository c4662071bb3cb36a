"""The public names of `cocoro`, by `__all__`."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import cocoro

SOURCE = Path(cocoro.__file__).read_text(encoding="utf-8")


def test_every_public_name_is_found_in_the_module_that_defines_it() -> None:
    for name in cocoro.__all__:
        assert getattr(cocoro, name) is not None
    assert cocoro.Node.__module__ == "cocoro.node"
    assert cocoro.Component.__module__ == "cocoro.component"


def test_type_checkers_see_the_same_names_from_the_same_modules() -> None:
    for node in ast.walk(ast.parse(SOURCE)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("cocoro."):
            for alias in node.names:
                assert getattr(sys.modules[node.module], alias.name) is getattr(cocoro, alias.name)
    typed = {
        alias.name
        for node in ast.walk(ast.parse(SOURCE))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("cocoro.")
        for alias in node.names
    }
    assert typed == set(cocoro.__all__)


def test_the_docstring_names_every_public_name() -> None:
    assert cocoro.__doc__ is not None
    kinds = {name for name in cocoro.__all__ if name.endswith(("Clock", "Error"))}  # the docstring names their kind
    assert [name for name in cocoro.__all__ if f"`{name}`" not in cocoro.__doc__ and name not in kinds] == []


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        cocoro.Nothing  # type: ignore[attr-defined] # noqa: B018


@pytest.mark.process
def test_importing_the_package_alone_loads_none_of_its_modules() -> None:
    code = "import sys, cocoro; print(*[name for name in sys.modules if name.startswith('cocoro.')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
