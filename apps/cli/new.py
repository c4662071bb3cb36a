"""`cocoro new service NAME`: writes a distribution with a working component and its tests."""

from __future__ import annotations

import importlib.util
import keyword
import re
import sys
from collections.abc import Iterator
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path, PurePosixPath
from typing import Annotated

import typer

from apps.cli import exits
from cocoro.errors import ConfigError
from deploy import processes

TEMPLATE = "templates/service"
SUFFIX = ".template"
NAME = r"[a-z][a-z0-9_-]{0,31}"
"""Valid names: a chunk of a key, and with '_' for '-' a Python package."""


app = typer.Typer()
new = typer.Typer(no_args_is_help=True, help="Write a component from a template: `cocoro new service NAME`.")
app.add_typer(new, name="new")


@new.callback()
def _new() -> None:
    """Makes `new` a group of commands, although it has one."""


@new.command()
def service(
    name: Annotated[str, typer.Argument(help="Name of the service, the first part of its keys: nearest.")],
    into: Annotated[Path, typer.Option(metavar="DIR", help="The folder that its folder goes into.")] = Path(),
) -> None:
    """A working component with its test, as a package of your own: see docs/components.md."""
    sys.exit(write_service(name, into))


def write_service(name: str, into: Path) -> int:
    """Writes the component into the folder `into`/`name`. Raises ConfigError for an invalid or taken name."""
    folder = into / name
    if folder.exists():
        raise ConfigError(f"{folder} exists already; choose another name, or another place with --into")
    package = package_of(name)
    words = {"name": name, "package": package, "class": "".join(part.capitalize() for part in re.split("[-_]+", name))}
    for path, text in files(words):
        target = folder / path
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{target} cannot be written: {error.strerror}") from error
        print(target)
    hints = (
        (f"pytest {folder}", "runs its tests"),
        (f"pip install -e {folder}", "installs it"),
        (f"cocoro run {name}", "runs it beside a robot that is up"),
        (f"cocoro echo {name}/travelled", "prints its messages"),
    )
    print(f"\nIts computation is in {folder / package / 'core.py'}. Next:")
    for command, what in hints:
        print(f"  {command:<{max(len(command) for command, _ in hints)}}  # {what}")
    return exits.DONE


def package_of(name: str) -> str:
    """The Python package of a component. Raises ConfigError for a name that is not valid or is taken."""
    if not re.fullmatch(NAME, name):
        raise ConfigError(f"{name!r} is not a valid name: small letters, digits, '_' and '-', a letter first")
    package = name.replace("-", "_")
    for row in processes.table().values():
        if name in (row.name, *row.services):
            raise ConfigError(f"there is a service {name} already (process {row.name}); choose another name")
    spec = None if keyword.iskeyword(package) else importlib.util.find_spec(package)
    taken = spec is not None and spec.origin is not None  # a folder without __init__.py is not taken
    if keyword.iskeyword(package) or package in sys.stdlib_module_names or taken:
        raise ConfigError(f"there is a Python module {package} already; choose another name")
    return package


def files(words: dict[str, str]) -> Iterator[tuple[PurePosixPath, str]]:
    """The files of the template with `words` filled in: path below the component's folder, and text."""
    for path, source in _walk(resources.files("apps").joinpath(TEMPLATE), PurePosixPath()):
        text = source.read_text(encoding="utf-8")
        for word, value in words.items():
            text = text.replace(f"{{{{{word}}}}}", value)
        parts = (part.removesuffix(SUFFIX).replace("package", words["package"]) for part in path.parts)
        yield PurePosixPath(*parts), text


def _walk(folder: Traversable, path: PurePosixPath) -> Iterator[tuple[PurePosixPath, Traversable]]:
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if entry.is_dir():
            yield from _walk(entry, path / entry.name)
        elif entry.name.endswith(SUFFIX):
            yield path / entry.name, entry
