"""The libraries of each installation: which extra of `cocoro-mesh` has a library that is missing here."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable, Iterator
from importlib import metadata

from cocoro.component import Component

PROJECT = "cocoro-mesh"
EXTRAS = ("operator", "robot", "sim", "view", "tables", "foxglove", "experiments", "dev")
"""The extras, from the smallest on; of several that have a library the first is advised."""
MODULES = {
    "dynamixel-sdk": "dynamixel_sdk",
    "eclipse-zenoh": "zenoh",
    "foxglove-sdk": "foxglove",
    "opencv-python-headless": "cv2",
    "pyserial": "serial",
    "rerun-sdk": "rerun",
}
"""Names of the modules that are not named like their distributions."""


def missing(components: Iterable[Component]) -> Iterator[str]:
    """The distributions that the components need and that are not installed."""
    for library in dict.fromkeys(library for component in components for library in component.libraries):
        if importlib.util.find_spec(MODULES.get(library, library.replace("-", "_"))) is None:
            yield library


def advice(library: str) -> str:
    """How to install a distribution: `pip install 'cocoro-mesh[sim]'`, or by its own name when no extra has it."""
    found = [extra for extra in EXTRAS if library in _libraries_of(extra)]
    return f"pip install '{PROJECT}[{found[0]}]'" if found else f"pip install {library}"


def advice_of(error: BaseException) -> str | None:
    """The sentence about a failed import; None for another error, or a module of no library of this project."""
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return None
    name = error.name.partition(".")[0]
    library = next((library for library, own in MODULES.items() if own == name), name)
    known = {library for extra in (None, *EXTRAS) for library in _libraries_of(extra)}
    return f"this needs {library}, which is not installed: {advice(library)}" if library in known else None


def _libraries_of(extra: str | None) -> set[str]:
    """The distributions that an extra names, or with None the project itself."""
    try:
        lines = metadata.requires(PROJECT) or []
    except metadata.PackageNotFoundError:
        return set()
    found = set()
    for line in lines:
        name, _, marker = line.partition(";")
        of = re.search(r"extra == ['\"]([\w-]+)['\"]", marker)
        if (of[1] if of else None) == extra:
            found.add(re.split(r"[\s<>=!~\[(]", name.strip(), maxsplit=1)[0])
    return found - {PROJECT}
