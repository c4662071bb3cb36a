"""The benches by name. `make bench` runs those of the suite; a trial has options of its own and may take hours."""

from __future__ import annotations

import ast
import importlib
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, cast

from bench.report import Report


class Bench(Protocol):
    """The module of an entry; see `bench/report.py`."""

    def measure(self, chosen: Namespace, report: Report) -> None: ...


class Entry(NamedTuple):
    """A bench: the module that has it, and who runs it."""

    module: str
    kind: Literal["suite", "trial"] = "trial"

    @property
    def about(self) -> str:
        """The first line of the module's docstring, read without importing it."""
        source = Path(__file__).parent.joinpath(f"{self.module}.py").read_text()
        return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]

    def load(self) -> Bench:
        """Import the module."""
        return cast(Bench, importlib.import_module(f"bench.{self.module}"))

    def options(self, parser: ArgumentParser) -> None:
        """Add the module's own options, if it has some."""
        add = getattr(self.load(), "options", None)
        if add is not None:
            add(parser)


ENTRIES: dict[str, Entry] = {
    "decoupling": Entry("decoupling", "suite"),
    "fetch": Entry("fetch", "suite"),
    "pixel": Entry("pixel", "suite"),
    "baselines": Entry("baselines", "suite"),
    "learning": Entry("learning", "suite"),
    "perception": Entry("perception", "suite"),
}
