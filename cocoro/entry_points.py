"""Entry points: values that installed distributions of third parties add to a group."""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from cocoro.distributions import may_add_to


class Added(NamedTuple):
    """One value that a third party added."""

    name: str
    """The entry point's name."""
    value: Any
    origin: str
    """The entry point and its distribution, for messages."""


class EntryPoints(NamedTuple):
    """The entry points of one group."""

    added: tuple[Added, ...]
    faults: tuple[str, ...]
    """For each one that could not be loaded, the reason."""


def lent(module: str, name: str) -> object:
    """A name of a module above this package, which lends it to `cocoro`: loaded by name, so that nothing here imports
    it."""
    return getattr(import_module(module), name)


def third_partys(name: str) -> ModuleType:
    """A module that a setting names: `package.module`, or a file that ends with .py. Raises FileNotFoundError where
    there is no such file, and what the module's code raises."""
    if not name.endswith(".py"):
        return import_module(name)
    path = Path(name)
    spec = spec_from_file_location(f"cocoro_of_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise FileNotFoundError(name)
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for their own
    spec.loader.exec_module(module)
    return module


@cache
def added_to(group: str) -> EntryPoints:
    """Load the entry points of a group, once in a process. One that cannot be loaded does not disturb the others."""
    if not may_add_to(group):
        return EntryPoints((), ())
    from importlib.metadata import entry_points  # takes 20 ms to import, which most processes never need

    added, faults = [], []
    for point in entry_points(group=group):
        origin = f"entry point {point.name!r} of {point.dist.name if point.dist else 'an unknown distribution'}"
        try:
            added.append(Added(point.name, point.load(), origin))
        except (Exception, SystemExit) as error:  # third-party code runs here, whatever it does
            faults.append(f"{origin} cannot be loaded: {type(error).__name__}: {error}")
    return EntryPoints(tuple(added), tuple(faults))
