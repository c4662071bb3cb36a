"""`cocoro new service NAME` and `cocoro new task NAME`: write a distribution with a working component or task; and
`cocoro new robot NAME`, whose files `apps.cli.new_robot` writes."""

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
from apps.cli.listed import COMMANDS
from apps.cli.new_files import check_name, free_folder, put, tell_of
from apps.cli.options import JsonOption
from cocoro.errors import ConfigError
from deploy import processes
from services.executive.tasks import TASKS

SERVICE, TASK = "templates/service", "templates/task"
SUFFIX = ".template"


app = typer.Typer()
new = typer.Typer(
    no_args_is_help=True,
    help="Write a component (`new service NAME`), a task (`new task NAME`) or a robot (`new robot NAME`).",
)
app.add_typer(new, name="new")


@new.command()
def service(
    name: Annotated[str, typer.Argument(help="Name of the service, the first part of its keys: nearest.")],
    into: Annotated[Path, typer.Option(metavar="DIR", help="The folder that its folder goes into.")] = Path(),
    json: JsonOption = False,
) -> None:
    """A working component with its test, as a package of your own."""
    sys.exit(write_service(name, into, json))


@new.command()
def task(
    name: Annotated[str, typer.Argument(help="Name of the task, and of its command: greet.")],
    into: Annotated[Path, typer.Option(metavar="DIR", help="The folder that its folder goes into.")] = Path(),
    json: JsonOption = False,
) -> None:
    """A working task with its test, as a package of your own."""
    sys.exit(write_task(name, into, json))


@new.command()
def robot(
    name: Annotated[str, typer.Argument(help="Name of the robot, the first part of all its keys: ada.")],
    urdf: Annotated[Path, typer.Option("--urdf", metavar="FILE", help="The robot's URDF, its meshes beside it.")],
    into: Annotated[Path, typer.Option(metavar="DIR", help="The folder that its folder goes into.")] = Path(),
    json: JsonOption = False,
) -> None:
    """A description and a profile from a URDF, which run in the simulator, and a page of what is missing."""
    from apps.cli.new_robot import write_robot  # imports the simulator's body

    sys.exit(write_robot(name, urdf, into, json))


def write_service(name: str, into: Path, as_json: bool = False) -> int:
    """Writes the component into the folder `into`/`name`. Raises ConfigError for an invalid or taken name."""
    folder = free_folder(name, into)
    package = package_of(name)
    made = write(SERVICE, name, folder)
    hints = (
        (f"pytest {folder}", "runs its tests"),
        (f"pip install -e {folder}", "installs it"),
        (f"cocoro run {name}", "runs it beside a robot that is up"),
        (f"cocoro echo {name}/travelled", "prints its messages"),
    )
    tell_of(made, f"Its computation is in {folder / package / 'core.py'}.", hints, as_json)
    return exits.DONE


def write_task(name: str, into: Path, as_json: bool = False) -> int:
    """Writes the task into the folder `into`/`name`. Raises ConfigError for an invalid or taken name."""
    folder = free_folder(name, into)
    package = package_of(name)
    if name in TASKS.all():
        raise ConfigError(f"there is a task {name} already; choose another name")
    if name in {row.name for row in COMMANDS}:
        raise ConfigError(f"there is a command `cocoro {name}` already; choose another name")
    hints = (
        (f"pip install -e {folder}", "installs it"),
        (f"pytest {folder}", "runs its test"),
        (f"cocoro rehearse {name}", "tries it in simulation"),
        (f"cocoro {name}", "runs it on a robot that is up"),
    )
    tell_of(write(TASK, name, folder), f"Its type is in {folder / package}.py.", hints, as_json)
    return exits.DONE


def write(template: str, name: str, folder: Path) -> list[Path]:
    """Writes the files of a template and returns their paths. Raises ConfigError when one cannot be written."""
    words = {
        "name": name,
        "package": name.replace("-", "_"),
        "class": "".join(part.capitalize() for part in re.split("[-_]+", name)),
    }
    made = []
    for path, text in files(template, words):
        put(folder / path, text)
        made.append(folder / path)
    return made


def package_of(name: str) -> str:
    """The Python package of a component or task. Raises ConfigError for a name that is not valid or is taken."""
    check_name(name)
    package = name.replace("-", "_")
    for row in processes.table().values():
        if name in (row.name, *row.services):
            raise ConfigError(f"there is a service {name} already (process {row.name}); choose another name")
    spec = None if keyword.iskeyword(package) else importlib.util.find_spec(package)
    taken = spec is not None and spec.origin is not None  # a folder without __init__.py is not taken
    if keyword.iskeyword(package) or package in sys.stdlib_module_names or taken:
        raise ConfigError(f"there is a Python module {package} already; choose another name")
    return package


def files(template: str, words: dict[str, str]) -> Iterator[tuple[PurePosixPath, str]]:
    """The files of a template with `words` filled in: path below the new folder, and text."""
    for path, source in _walk(resources.files("apps").joinpath(template), PurePosixPath()):
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
