"""The libraries of each installation: which extra of `cocoro-mesh` has a library that is missing here."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable, Iterator
from importlib import metadata

from cocoro.component import Component
from cocoro.errors import ConfigError

PROJECT = "cocoro-mesh"
EXTRAS = (
    "operator", "cockpit", "robot", "sim", "site", "view", "tables", "lerobot", "foxglove", "policy", "experiments",
    "bench", "dev",
)  # fmt: skip
"""The extras, from the smallest on; of several that have a library the first is advised."""
NEEDED = {"rehearse": "sim", "experiment": "sim"}
"""The extra that a command needs as a whole, so that the first missing library does not lead to the next one."""
MODULES = {
    "dynamixel-sdk": "dynamixel_sdk",
    "dora-rs": "dora",
    "eclipse-ecal": "ecal",
    "eclipse-zenoh": "zenoh",
    "foxglove-sdk": "foxglove",
    "opencv-python-headless": "cv2",
    "pyserial": "serial",
    "pyzmq": "zmq",
    "rerun-sdk": "rerun",
}
"""Names of the modules that are not named like their distributions."""


def missing(components: Iterable[Component]) -> Iterator[str]:
    """The distributions that the components need and that are not installed."""
    for library in dict.fromkeys(library for component in components for library in component.libraries):
        if importlib.util.find_spec(MODULES.get(library, library.replace("-", "_"))) is None:
            yield library


def require(what: str, components: Iterable[Component]) -> None:
    """Raises ConfigError when `what`, a command, needs libraries that are not installed."""
    if lacking := list(missing(components)):
        are = "is" if len(lacking) == 1 else "are"
        raise ConfigError(f"`{what}` needs {' and '.join(lacking)}, which {are} not installed: {advice(*lacking)}")


def advice(*libraries: str) -> str:
    """The command that installs distributions: `pip install 'cocoro-mesh[sim]'`, or by their own names when no extra
    has all."""
    found = [extra for extra in EXTRAS if set(libraries) <= _libraries_of(extra)]
    return f"pip install '{PROJECT}[{found[0]}]'" if found else f"pip install {' '.join(libraries)}"


def advice_of(error: BaseException, command: str = "") -> str | None:
    """The sentence about a failed import, for one who gave a command; None for another error, or a module of no library
    of this project."""
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return None
    name = error.name.partition(".")[0]
    library = next((library for library, own in MODULES.items() if own == name), name)
    known = {library for extra in (None, *EXTRAS) for library in _libraries_of(extra)}
    if library not in known:
        return None
    extra = NEEDED.get(command)
    how = f"pip install '{PROJECT}[{extra}]'" if extra and library in _libraries_of(extra) else advice(library)
    return f"this needs {library}, which is not installed: {how}"


def _libraries_of(extra: str | None) -> set[str]:
    """The distributions that an extra brings, or with None the project itself."""
    try:
        lines = metadata.requires(PROJECT) or []
    except metadata.PackageNotFoundError:
        return set()
    found: set[str] = set()
    for line in lines:
        name, _, marker = line.partition(";")
        of = re.search(r"extra == ['\"]([\w-]+)['\"]", marker)
        if (of[1] if of else None) != extra:
            continue
        library = re.split(r"[\s<>=!~\[(]", name.strip(), maxsplit=1)[0]
        inner = re.search(r"\[([\w-]+)\]", name)
        found |= {library} if library != PROJECT else _libraries_of(inner[1]) if inner else set()
    return found
